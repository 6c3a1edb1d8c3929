"""MCP23008: eight pins. 0 to 2 enable the laser-diode controllers; key, interlock and over-power are pins 4 to 6.

After reset every pin is an input, and the board pulls the enables low.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from firmware_iface.lasers.i2c_transfers import write

if TYPE_CHECKING:
    from smbus2 import SMBus

IODIR, OLAT = 0x00, 0x0A
ENABLES = 0b0000_0111


class Mcp23008:
    """The expander.

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

    def __init__(self, bus: SMBus, address: int = 0x20) -> None:
        self._bus, self._address = bus, address

    def enable(self, lasers: int) -> None:
        """Enable the lasers whose bits are set, disable the others."""
        write(self._bus, self._address, bytes([OLAT, lasers & ENABLES]))
        write(self._bus, self._address, bytes([IODIR, ~ENABLES & 0xFF]))
