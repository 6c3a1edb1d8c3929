"""Panels (phase-only spatial light modulators): a panel board over USB, TI's DLPC900, and screens."""

from firmware_iface.panel.dlpc900 import open_dlpc900
from firmware_iface.panel.fields import Field, FieldPanel, colours_in_turn
from firmware_iface.panel.mirrored_display import MirroredDisplay, open_mirrored
from firmware_iface.panel.panel import Panel, checked_gray
from firmware_iface.panel.panel_board import open_board

__all__ = [
    "Field",
    "FieldPanel",
    "MirroredDisplay",
    "Panel",
    "checked_gray",
    "colours_in_turn",
    "open_board",
    "open_dlpc900",
    "open_mirrored",
]
