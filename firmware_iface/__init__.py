"""Devices of a holographic headset, and virtual ones with a simulated bench behind them.

At most numpy is imported here; vendor libraries are imported when a device is opened.
"""

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError

__all__ = ["DeviceError", "DeviceGoneError", "InputError"]
