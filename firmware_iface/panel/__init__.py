"""Phase panels: our own panel board, TI's DLPC900, mirrored displays, and what slmsuite drives."""

from firmware_iface.panel.board import open_board
from firmware_iface.panel.dlpc900 import open_dlpc900
from firmware_iface.panel.mirrored import MirroredDisplay, open_mirrored
from firmware_iface.panel.panel import Panel, checked_gray

__all__ = ["MirroredDisplay", "Panel", "checked_gray", "open_board", "open_dlpc900", "open_mirrored"]
