"""Access to 16-bit registers by a pointer, high byte first, as the ADS1115 and the TMP117 have it."""

from __future__ import annotations

from abc import ABC, abstractmethod


class WordRegisters(ABC):
    """A part whose write is pointer, high, low, and whose read gives the register under the pointer."""

    _pointer = 0

    @abstractmethod
    def fetch(self, register: int) -> int:
        """A register's value as it is read, 0 to 65535."""

    @abstractmethod
    def store(self, register: int, value: int) -> None:
        """Store a written value."""

    def write(self, data: bytes) -> None:
        """Pointer alone, or pointer and value."""
        if data:
            self._pointer = data[0]
        if len(data) >= 3:
            self.store(self._pointer, int.from_bytes(data[1:3], "big"))

    def read(self, length: int) -> bytes:
        """The register, repeated."""
        value = self.fetch(self._pointer).to_bytes(2, "big") if length else b""
        return (value * (length // 2 + 1))[:length]

    def stop(self) -> None:  # noqa: B027 - doing nothing is what these parts do
        """Nothing waits for STOP."""


def signed(word: int) -> int:
    """Two's complement of 16 bits."""
    return word - 0x10000 if word & 0x8000 else word
