"""The part of libnop's wire format in which depthai describes its messages.

A structure is a tuple, an array a list; integers are signed unless wrapped in Unsigned, floats have 32 bits.
"""

from __future__ import annotations

import struct
from typing import Any


class Unsigned(int):
    """An integer that is written as unsigned."""


class Encoded(bytes):
    """A value that is written already."""


_STRUCTURE, _ARRAY, _MAP, _BINARY, _STRING, _NIL = 0xB9, 0xBA, 0xBB, 0xBC, 0xBD, 0xBE
_FLOAT, _DOUBLE, _VARIANT = 0x88, 0x89, 0xB8


def encode(value: Any) -> bytes:
    """One value as bytes.

    Raises
    ------
    TypeError
        For a type or a number that the format cannot hold.
    """
    match value:
        case Encoded():
            return bytes(value)
        case bool():
            return bytes([value])
        case Unsigned():
            return _unsigned(value)
        case int():
            return _signed(value)
        case float():
            return bytes([_FLOAT]) + struct.pack("<f", value)
        case str():
            return bytes([_STRING]) + _unsigned(len(value.encode())) + value.encode()
        case tuple():
            return bytes([_STRUCTURE]) + _unsigned(len(value)) + b"".join(map(encode, value))
        case list():
            return bytes([_ARRAY]) + _unsigned(len(value)) + b"".join(map(encode, value))
        case None:
            return bytes([_NIL])
    raise TypeError(f"libnop has no place for a {type(value).__name__}")


def decode(data: bytes) -> Any:
    """The value that `data` begins with.

    Raises
    ------
    ValueError
        Where the data is no value.
    """
    try:
        return _decode(data, 0, 0)[0]
    except (IndexError, struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"not a libnop value: {error}") from error


def _unsigned(value: int) -> bytes:
    if value <= 0x7F:
        return bytes([value])
    for code, size in enumerate((1, 2, 4, 8)):
        if value < 1 << 8 * size:
            return bytes([0x80 + code]) + int(value).to_bytes(size, "little")
    raise TypeError(f"{value} has more than 64 bits")


def _signed(value: int) -> bytes:
    if -64 <= value <= 0x7F:
        return bytes([value & 0xFF])
    for code, size in enumerate((1, 2, 4, 8)):
        if -(1 << 8 * size - 1) <= value < 1 << 8 * size - 1:
            return bytes([0x84 + code]) + value.to_bytes(size, "little", signed=True)
    raise TypeError(f"{value} has more than 64 bits")


def _decode(data: bytes, at: int, depth: int) -> tuple[Any, int]:
    if depth > 32:
        raise ValueError("not a libnop value: nested too deep")
    prefix, at = data[at], at + 1
    if prefix <= 0x7F:
        return prefix, at
    if prefix >= 0xC0:
        return prefix - 256, at
    if prefix <= 0x87:
        size = 1 << prefix % 4
        if at + size > len(data):
            raise ValueError("not a libnop value: cut short")
        return int.from_bytes(data[at : at + size], "little", signed=prefix >= 0x84), at + size
    if prefix == _FLOAT:
        return struct.unpack_from("<f", data, at)[0], at + 4
    if prefix == _DOUBLE:
        return struct.unpack_from("<d", data, at)[0], at + 8
    if prefix == _NIL:
        return None, at
    if prefix == _VARIANT:
        index, at = _decode(data, at, depth + 1)
        value, at = _decode(data, at, depth + 1)
        return (index, value), at
    if prefix not in (_STRUCTURE, _ARRAY, _MAP, _BINARY, _STRING):
        raise ValueError(f"not a libnop value: prefix 0x{prefix:02x}")
    count, at = _decode(data, at, depth + 1)
    if not isinstance(count, int) or count < 0 or count > len(data):
        raise ValueError("not a libnop value: a count that cannot be")
    if prefix in (_BINARY, _STRING):
        if at + count > len(data):
            raise ValueError("not a libnop value: cut short")
        raw = data[at : at + count]
        return (raw if prefix == _BINARY else raw.decode()), at + count
    values = []
    for _ in range(count * (2 if prefix == _MAP else 1)):
        value, at = _decode(data, at, depth + 1)
        values.append(value)
    if prefix == _MAP:
        return list(zip(values[::2], values[1::2], strict=True)), at
    return (tuple(values) if prefix == _STRUCTURE else values), at
