"""Lasers over I2C. Emission needs key, interlock, heartbeat and no fault, combined in the board's safety controller.

Software does not make a product Class 1: see eye_safety.py for what is budgeted and safety_controller.md for what the
hardware must do. Have a test house classify the product.
"""

from firmware_iface.lasers.channels import VIRTUAL_CHANNELS, LaserChannel
from firmware_iface.lasers.lasers import Lasers
from firmware_iface.lasers.open_board import open_lasers

__all__ = ["VIRTUAL_CHANNELS", "LaserChannel", "Lasers", "open_lasers"]
