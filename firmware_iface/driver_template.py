"""A driver to copy for the next device: a thermometer in a headset's eyepiece, over USB.

Copy this file and `tests/firmware_iface/test_driver_template.py`, and change four things:

1. the commands (here one vendor request, its layout written down where it is parsed),
2. the parse function: bytes in, a value or ValueError out, nothing else, so that it can be fuzzed,
3. the class: a handful of methods in physical units, each a transfer that succeeded or a DeviceError,
4. the model (here ThermometerModel in the test): the same bytes written down a second time, from the
   device's documentation and not from the driver, on `virtual.usb.usb_model.UsbModel` or the I2C bus.

The tests are the same for every device: the bytes of opening and using it, each fault of
`virtual.fault_injection.KINDS` that its bus knows, unplug and replug, and random bytes into the parse function.
"""

from __future__ import annotations

import struct
from typing import Any

from firmware_iface.errors import DeviceError
from firmware_iface.usb_link import UsbLink

VENDOR, PRODUCT = 0x1209, 0x0002
READ_TEMPERATURE = 1


def parse_temperature(reply: bytes) -> float:
    """Temperature from i16 in 0.01 °C and its complement.

    Parameters
    ----------
    reply : bytes

    Returns
    -------
    float, °C

    Raises
    ------
    ValueError
        Where these are not four such bytes.
    """
    value, complement = struct.unpack("<hh", reply) if len(reply) == 4 else (0, 0)
    if value != ~complement:
        raise ValueError("the reply is garbled")
    return value / 100


class Thermometer:
    """The device; the bus is a parameter, so that it runs on an emulated one.

    Parameters
    ----------
    backend : pyusb backend or None
        None is the system's libusb.
    timeout_s : float, s
        Longest wait for one transfer.
    """

    def __init__(self, backend: Any = None, timeout_s: float = 0.5) -> None:
        self._link = UsbLink(VENDOR, PRODUCT, "the thermometer", backend=backend, timeout_s=timeout_s)
        self._link.open()

    def temperature_c(self) -> float:
        """Temperature, °C.

        Raises
        ------
        DeviceError
            Where it does not answer or the reply is garbled.
        """
        try:
            return parse_temperature(self._link.control_in(READ_TEMPERATURE, 4))
        except ValueError as error:
            raise DeviceError(f"the thermometer: {error}; check its cable.") from error

    def status(self) -> dict[str, Any]:
        """What the device reports; raises as `temperature_c`."""
        return {"temperature_c": self.temperature_c()}

    def close(self) -> None:
        """Release the device."""
        self._link.close()
