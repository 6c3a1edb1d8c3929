"""Phase panels: our own panel board, TI's DLPC900, mirrored displays, and what slmsuite drives."""

from .board import open_board
from .panel import Panel, checked_gray

__all__ = ["Panel", "checked_gray", "open_board"]
