"""Phase panels: our own panel board, TI's DLPC900, mirrored displays, and what slmsuite drives."""

from .board import open_board
from .dlpc900 import open_dlpc900
from .mirrored import MirroredDisplay, open_mirrored
from .panel import Panel, checked_gray

__all__ = ["MirroredDisplay", "Panel", "checked_gray", "open_board", "open_dlpc900", "open_mirrored"]
