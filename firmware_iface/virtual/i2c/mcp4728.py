"""MCP4728, quad 12-bit DAC with an EEPROM, after its data sheet. LDAC is tied low: outputs follow at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from firmware_iface.virtual.i2c.bus import NackError

SUPPLY_V, REFERENCE_V = 5.0, 2.048
EEPROM_WRITE_S = 0.05


@dataclass(frozen=True)
class Setting:
    """Setting of one channel.

    Attributes
    ----------
    internal : bool
        Internal reference; else the supply.
    power_down : int
        Mode; 0: on.
    doubled : bool
        Gain of two.
    code : int
        0 to 4095.
    """

    internal: bool = False
    power_down: int = 0
    doubled: bool = False
    code: int = 0

    @classmethod
    def decode(cls, high: int, low: int) -> Setting:
        """From the two bytes VREF PD1 PD0 GAIN D11..D8, D7..D0."""
        return cls(bool(high >> 7), high >> 5 & 3, bool(high >> 4 & 1), (high & 15) << 8 | low)

    def encode(self) -> bytes:
        """The two bytes again."""
        flags = self.internal << 7 | self.power_down << 5 | self.doubled << 4
        return bytes([flags | self.code >> 8, self.code & 0xFF])

    @property
    def volts(self) -> float:
        """Voltage of the pin."""
        if self.power_down:
            return 0.0
        full = REFERENCE_V * (1 + self.doubled) if self.internal else SUPPLY_V
        return min(full * self.code / 4096, SUPPLY_V)


class Mcp4728:
    """Channels A to D.

    Parameters
    ----------
    clock : callable
        Gives the time, s, for the EEPROM's write time.
    eeprom : list of Setting or None
        Settings at power-on; none: as written dark.
    """

    def __init__(self, clock: Callable[[], float], eeprom: list[Setting] | None = None) -> None:
        self._clock = clock
        self.eeprom = eeprom or [Setting(internal=True, power_down=1)] * 4
        self._busy_until = clock()
        self.power_on()

    def power_on(self) -> None:
        """Outputs as stored in the EEPROM."""
        self.channels = list(self.eeprom)

    def volts(self, channel: int) -> float:
        """Output of channel 0 (A) to 3 (D), V."""
        return self.channels[channel].volts

    def write(self, data: bytes) -> None:
        """One write message; commands are ignored while the EEPROM is written."""
        if not data or self._clock() < self._busy_until:
            return
        command = data[0] >> 5
        if command <= 1:
            self._fast(data)
        elif command == 2:
            self._multi(data)
        elif command in (4, 6):
            self._flags("internal" if command == 4 else "doubled", data[0])
        elif command == 5 and len(data) >= 2:
            modes = (data[0] >> 2, data[0], data[1] >> 6, data[1] >> 4)
            self.channels = [replace(c, power_down=m & 3) for c, m in zip(self.channels, modes, strict=True)]
        else:
            raise NackError

    def _fast(self, data: bytes) -> None:
        for i in range(len(data) // 2):
            high, low = data[2 * i], data[2 * i + 1]
            self.channels[i % 4] = replace(
                self.channels[i % 4], power_down=high >> 4 & 3, code=(high & 15) << 8 | low
            )

    def _multi(self, data: bytes) -> None:
        kind, channel = data[0] >> 3 & 3, data[0] >> 1 & 3
        if kind == 0:  # multi-write: a command byte before every channel
            for i in range(0, len(data) - 2, 3):
                if data[i] >> 3 != 0b01000:
                    raise NackError
                self.channels[data[i] >> 1 & 3] = Setting.decode(data[i + 1], data[i + 2])
            return
        last = 3 if kind == 2 else channel  # sequential to D, or one channel
        if kind == 1:
            raise NackError
        for i, c in enumerate(range(channel, last + 1)):
            if len(data) < 3 + 2 * i:
                break
            self.channels[c] = self.eeprom[c] = Setting.decode(data[1 + 2 * i], data[2 + 2 * i])
            self._busy_until = self._clock() + EEPROM_WRITE_S

    def _flags(self, name: str, bits: int) -> None:
        self.channels = [replace(c, **{name: bool(bits >> (3 - i) & 1)}) for i, c in enumerate(self.channels)]

    def read(self, length: int) -> bytes:
        """For each channel: status, register; status, EEPROM; 24 bytes, then again."""
        ready = self._clock() >= self._busy_until
        out = b""
        for i, (now, kept) in enumerate(zip(self.channels, self.eeprom, strict=True)):
            status = bytes([ready << 7 | 1 << 6 | i << 4])
            out += status + now.encode() + status + kept.encode()
        return (out * (1 + length // len(out)))[:length]

    def stop(self) -> None:
        """Nothing waits for STOP."""

    def general_call(self, data: bytes) -> None:
        """Address 0: 06 reset to the EEPROM, 08 update (outputs follow anyway), 09 wake up."""
        if data[:1] == b"\x06":
            self.power_on()
        elif data[:1] == b"\x09":
            self.channels = [replace(c, power_down=0) for c in self.channels]
