"""Byte-level models of devices on USB, and the backend that puts them behind pyusb."""

from firmware_iface.virtual.usb.dlpc900 import Dlpc900Model
from firmware_iface.virtual.usb.panel_board import BoardModel
from firmware_iface.virtual.usb.pyusb_backend import VirtualUsb
from firmware_iface.virtual.usb.usb_model import UsbModel

__all__ = ["BoardModel", "Dlpc900Model", "UsbModel", "VirtualUsb"]
