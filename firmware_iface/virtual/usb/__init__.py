"""Byte-level models of devices on USB, and the backend that puts them behind pyusb."""

from .backend import VirtualUsb
from .board import BoardModel
from .device import UsbModel

__all__ = ["BoardModel", "UsbModel", "VirtualUsb"]
