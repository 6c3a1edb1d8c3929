"""Devices of a holographic display: panel (spatial light modulator, SLM), lasers and camera, real or simulated.

At most numpy is imported here; vendor libraries are imported when a device is opened. firmware_iface/README.md is its
guide.
"""

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError

__all__ = ["DeviceError", "DeviceGoneError", "InputError"]
