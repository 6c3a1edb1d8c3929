"""The packet error code of SMBus, as a part's firmware computes it: by table, byte by byte."""

from __future__ import annotations

from collections.abc import Iterable


def _table() -> bytes:
    entries = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ (0x107 if value & 0x80 else 0)
        entries.append(value & 0xFF)
    return bytes(entries)


TABLE = _table()


def pec(data: Iterable[int]) -> int:
    """CRC-8 (x^8 + x^2 + x + 1, from 0) over every byte of a transfer, addresses included."""
    check = 0
    for byte in data:
        check = TABLE[check ^ byte]
    return check
