"""MCP4728: the DAC whose four outputs set the lasers' currents. Internal reference, gain 1: 0.5 mV a code.

At 50 mA/V that is 0.025 mA a code and at most 102.4 mA. The part has no watchdog, and at power-on it shows what its
EEPROM holds: for both reasons the safety controller follows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from firmware_iface.errors import DeviceError
from firmware_iface.lasers.i2c_transfers import read, write

if TYPE_CHECKING:
    from smbus2 import SMBus

VOLTS_PER_CODE = 2.048 / 4096
MULTI_WRITE, SEQUENTIAL_WRITE = 0x40, 0x50
INTERNAL_REFERENCE = 0x80
OFF_500K = 0x60  # the output is off, 500 kΩ to ground
CHANNELS = 4


@dataclass(frozen=True)
class Output:
    """One channel as the part reports it.

    Attributes
    ----------
    code : int
        0 to 4095.
    powered : bool
    fine : bool
        Whether a code is 0.5 mV.
    """

    code: int
    powered: bool
    fine: bool

    @property
    def dark(self) -> bool:
        """Whether its output is 0 V."""
        return self.code == 0 or not self.powered


def decode(reply: bytes) -> tuple[list[Output], list[Output]]:
    """Outputs from the 24 bytes that the part sends.

    Each channel is status, two bytes of the register, status, two bytes of the EEPROM; bits 5 and 4 of the status
    count the channels.

    Returns
    -------
    (list of Output, list of Output)
        Outputs now, and after power-on.

    Raises
    ------
    DeviceError
        Where these are not such bytes.
    """
    if len(reply) != 6 * CHANNELS or any(reply[3 * i] >> 4 & 3 != i // 2 for i in range(2 * CHANNELS)):
        raise DeviceError(
            "the DAC (MCP4728) sent an impossible reply; check its wiring, then switch the board off and on."
        )
    found = [
        Output(
            (high & 15) << 8 | low, not high & OFF_500K, bool(high & INTERNAL_REFERENCE) and not high & 0x10
        )
        for high, low in (reply[3 * i + 1 : 3 * i + 3] for i in range(2 * CHANNELS))
    ]
    return found[0::2], found[1::2]


class Mcp4728:
    """The DAC.

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

    def __init__(self, bus: SMBus, address: int = 0x60) -> None:
        self._bus, self._address = bus, address

    def read(self) -> tuple[list[Output], list[Output]]:
        """(outputs now, outputs after power-on), A to D.

        Raises
        ------
        DeviceError
            Where the reply is garbled.
        """
        return decode(read(self._bus, self._address, 6 * CHANNELS))

    def set_code(self, channel: int, code: int) -> None:
        """Put out `code`, 0 to 4095, on channel 0 (A) to 3 (D), at once."""
        high, low = INTERNAL_REFERENCE | code >> 8, code & 0xFF
        write(self._bus, self._address, bytes([MULTI_WRITE | channel << 1, high, low]))

    def dark(self) -> None:
        """Code 0 on every channel, in one message (fast write)."""
        write(self._bus, self._address, bytes(2 * CHANNELS))

    def store_dark(self) -> None:
        """Make power-on dark: every channel off in the EEPROM, and now. It takes 50 ms.

        The EEPROM lasts for a million writes: do this when a board is made, not when it is opened."""
        off = bytes([INTERNAL_REFERENCE | OFF_500K, 0])
        write(self._bus, self._address, bytes([SEQUENTIAL_WRITE]) + CHANNELS * off)
