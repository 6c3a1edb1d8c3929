"""TI's enhanced run-length encoding of 24-bit images for the DLPC900 (DLPU018, pattern image compression).

A row is copies from the row above, repeated pixels and stretches of single pixels, in three bytes each.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

HEADER_BYTES = 48
_LONGEST = 0x7FFF  # a count has 15 bits
_SHORTEST_RUN = 3  # pixels; shorter runs cost less as single pixels


def encode(image: NDArray[np.uint32]) -> bytes:
    """Encode an image: its header, then its rows.

    Parameters
    ----------
    image : uint32 array [H, W]
        24 bits are used: bit position p of the controller is bit p here.

    Returns
    -------
    bytes
    """
    height, width = image.shape
    body = bytearray()
    for y in range(height):
        above = image[y - 1] if y else None
        body += _encode_row(image[y], above)
        body += b"\x00\x00"
    body += b"\x00\x01\x00"
    body += bytes(-len(body) % 4)
    return _header(width, height, HEADER_BYTES + len(body)) + bytes(body)


def _header(width: int, height: int, length: int) -> bytes:
    head = b"Spld" + struct.pack("<HHI", width, height, length) + b"\xff" * 8 + bytes(4)
    return (head + bytes([0, 2, 1])).ljust(HEADER_BYTES, b"\0")  # 2: enhanced run-length encoding


def _encode_row(row: NDArray[np.uint32], above: NDArray[np.uint32] | None) -> bytes:
    width = len(row)
    if above is not None and np.array_equal(row, above):
        return b"\x00\x01" + _count(width)
    pixels = row.astype(">u4").view(np.uint8).reshape(width, 4)[:, 1:].tobytes()
    edges = np.flatnonzero(np.diff(row)) + 1
    starts = np.concatenate(([0], edges))
    lengths = np.diff(np.concatenate((starts, [width])))
    long = lengths >= _SHORTEST_RUN
    out = bytearray()
    done = 0
    for start, length in zip(starts[long].tolist(), lengths[long].tolist(), strict=True):
        out += _single(pixels, done, start)
        out += _count(length) + pixels[3 * start : 3 * start + 3]
        done = start + length
    return bytes(out + _single(pixels, done, width))


def _single(pixels: bytes, begin: int, end: int) -> bytes:
    """Pixels begin to end one by one; one alone is written as a run of one."""
    stretch = pixels[3 * begin : 3 * end]
    if end - begin > 1:
        return b"\x00" + _count(end - begin) + stretch
    return (b"\x01" if stretch else b"") + stretch


def _count(number: int) -> bytes:
    if not 0 < number <= _LONGEST:
        raise ValueError(f"{number} pixels are out of range of the encoding")
    return bytes([number]) if number < 128 else bytes([number & 0x7F | 0x80, number >> 7])
