"""TMP117: temperature of the lasers' heat sink. Its ALERT pin goes to the safety controller (therm mode)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from firmware_iface.lasers.i2c_transfers import write, write_read

if TYPE_CHECKING:
    from smbus2 import SMBus

TEMPERATURE, CONFIG, HIGH, LOW, IDENTITY = 0, 1, 2, 3, 0x0F
DEGREES_PER_COUNT = 1 / 128
THERM_MODE = 0x0220 | 0x0010  # as after reset, with ALERT held between the limits


class Tmp117:
    """The thermometer.

    Parameters
    ----------
    bus : smbus2.SMBus
        Open.
    address : int

    Raises
    ------
    OSError
        From every method, where the bus does not carry a message.
    """

    def __init__(self, bus: SMBus, address: int = 0x49) -> None:
        self._bus, self._address = bus, address

    def identity(self) -> int:
        """The device's identity, 0x0117 in the low 12 bits."""
        return self._read(IDENTITY) & 0x0FFF

    def limit(self, celsius: float, release_celsius: float) -> None:
        """Hold ALERT from above `celsius` until below `release_celsius`."""
        for register, value in ((HIGH, celsius), (LOW, release_celsius)):
            counts = round(value / DEGREES_PER_COUNT)
            write(self._bus, self._address, bytes([register, *counts.to_bytes(2, "big", signed=True)]))
        write(self._bus, self._address, bytes([CONFIG, *THERM_MODE.to_bytes(2, "big")]))

    def limit_celsius(self) -> float:
        """The upper limit as the part holds it, °C."""
        return self._read(HIGH) * DEGREES_PER_COUNT

    def celsius(self) -> float:
        """Temperature, °C."""
        return self._read(TEMPERATURE) * DEGREES_PER_COUNT

    def _read(self, register: int) -> int:
        reply = write_read(self._bus, self._address, bytes([register]), 2)
        return int.from_bytes(reply, "big", signed=True)
