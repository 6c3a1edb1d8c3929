"""ADS1115: the converter that reads the photodiodes, and whose latching comparator trips on too much light.

It converts without pause, one photodiode at a time, ±2.048 V, 860 a second. Every photodiode's amplifier gives 1 V
at its laser's full power, so that one threshold is enough for all. Reading a conversion releases the comparator's
latch; the safety controller keeps its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from firmware_iface.lasers.i2c_transfers import write, write_read

if TYPE_CHECKING:
    from smbus2 import SMBus

CONVERSION, CONFIG, LOW, HIGH = range(4)
VOLTS_PER_COUNT = 2.048 / 32768
# ±2.048 V, continuous, 860 a second, comparator: traditional, active low, latching, after one conversion
CONFIGURATION = 0x0400 | 0x00E0 | 0x0004
SINGLE_ENDED = 0x4000


class Ads1115:
    """The converter.

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

    def __init__(self, bus: SMBus, address: int = 0x48) -> None:
        self._bus, self._address = bus, address

    def trip_above(self, volts: float) -> None:
        """Let ALERT latch on any conversion above `volts`."""
        counts = min(0x7FFF, round(volts / VOLTS_PER_COUNT))
        self._write(HIGH, counts)
        self._write(LOW, 0)

    def threshold_v(self) -> float:
        """The threshold as the part holds it, V."""
        return self._read(HIGH) * VOLTS_PER_COUNT

    def select(self, pin: int) -> None:
        """Convert input 0 to 3 from now on; its first value is ready after 1.3 ms."""
        self._write(CONFIG, CONFIGURATION | SINGLE_ENDED | pin << 12)

    def volts(self) -> float:
        """The newest conversion, V."""
        return self._read(CONVERSION) * VOLTS_PER_COUNT

    def _write(self, register: int, value: int) -> None:
        write(self._bus, self._address, bytes([register, *value.to_bytes(2, "big")]))

    def _read(self, register: int) -> int:
        reply = write_read(self._bus, self._address, bytes([register]), 2)
        return int.from_bytes(reply, "big", signed=True)
