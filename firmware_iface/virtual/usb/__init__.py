"""Byte-level models of devices on USB, and the backend that puts them behind pyusb."""

from .backend import VirtualUsb
from .board import BoardModel
from .device import UsbModel
from .dlpc900 import Dlpc900Model

__all__ = ["BoardModel", "Dlpc900Model", "UsbModel", "VirtualUsb"]
