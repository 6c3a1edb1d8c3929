"""Drivers for the devices of a holographic headset, and virtual devices with a simulated bench behind them.

The panel is a phase-only spatial light modulator (SLM). A file of `virtual/i2c` or `virtual/usb` with the name of a
driver is the model of the same part: `lasers/mcp4728.py` drives the DAC that `virtual/i2c/mcp4728.py` emulates,
`panel/dlpc900.py` the controller of `virtual/usb/dlpc900.py`. Model and driver share no code.

At most numpy is imported here; vendor libraries are imported when a device is opened. firmware_iface/README.md is its
guide.
"""

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError

__all__ = ["DeviceError", "DeviceGoneError", "InputError"]
