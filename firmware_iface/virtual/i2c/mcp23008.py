"""MCP23008, eight pins, after its data sheet. After reset all are inputs; the board pulls them low."""

from __future__ import annotations

from collections.abc import Callable

IODIR, IPOL, INTF, INTCAP, GPIO, OLAT = 0x00, 0x01, 0x07, 0x08, 0x09, 0x0A
COUNT = 11


class Mcp23008:
    """The expander.

    Parameters
    ----------
    outside : callable
        Gives the levels that the board puts on the pins, bit by bit.
    """

    def __init__(self, outside: Callable[[], int]) -> None:
        self._outside = outside
        self.power_on()

    def power_on(self) -> None:
        """Every pin an input."""
        self.registers = [0xFF] + [0] * (COUNT - 1)
        self._pointer = 0

    def pins(self) -> int:
        """Levels on the pins: driven where they are outputs, the board's where they are inputs."""
        inputs = self.registers[IODIR]
        return (self.registers[OLAT] & ~inputs) | (self._outside() & inputs)

    def write(self, data: bytes) -> None:
        """Register address, then values for it and the following ones."""
        if data:
            self._pointer = data[0] % COUNT
        for value in data[1:]:
            if self._pointer in (GPIO, OLAT):
                self.registers[OLAT] = value
            elif self._pointer not in (INTF, INTCAP):
                self.registers[self._pointer] = value
            self._pointer = (self._pointer + 1) % COUNT

    def read(self, length: int) -> bytes:
        """Values from the pointer on."""
        out = bytearray()
        for _ in range(length):
            is_port = self._pointer == GPIO
            out.append((self.pins() ^ self.registers[IPOL]) if is_port else self.registers[self._pointer])
            self._pointer = (self._pointer + 1) % COUNT
        return bytes(out)

    def stop(self) -> None:
        """Nothing waits for STOP."""
