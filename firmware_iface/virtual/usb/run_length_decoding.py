"""Compressed images as the DLPC900's model reads them (DLPU018); no code is shared with the driver's encoder."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray


class CommandError(Exception):
    """A command fails; `number` is the controller's error number."""

    def __init__(self, number: int) -> None:
        self.number = number


def decode_image(data: bytes, height: int, width: int) -> NDArray[np.uint32]:
    """Decode a compressed image with its header.

    Parameters
    ----------
    data : bytes
    height, width : int, pixels

    Returns
    -------
    uint32 array [height, width]

    Raises
    ------
    CommandError
        Where the data is no such image.
    """
    if len(data) < 48 or data[:4] != b"Spld" or struct.unpack_from("<HH", data, 4) != (width, height):
        raise CommandError(6)
    if data[25] != 2:
        raise CommandError(9)
    try:
        return _decode_rows(data[48:], height, width)
    except (IndexError, ValueError):
        raise CommandError(9) from None


def _decode_rows(data: bytes, height: int, width: int) -> NDArray[np.uint32]:
    out = np.zeros(height * width, np.uint32)
    at = done = 0

    def count() -> int:
        nonlocal at
        number = data[at]
        at += 1
        if number >= 128:
            number = number & 0x7F | data[at] << 7
            at += 1
        return number

    def pixels(number: int) -> NDArray[np.uint32]:
        nonlocal at
        raw = np.frombuffer(data, np.uint8, 3 * number, at).reshape(number, 3).astype(np.uint32)
        at += 3 * number
        return np.asarray(raw[:, 0] << 16 | raw[:, 1] << 8 | raw[:, 2], np.uint32)

    def room(number: int) -> int:
        if done + number > len(out):
            raise ValueError("more pixels than the image has")
        return number

    while True:
        if data[at]:
            number = room(count())
            out[done : done + number] = pixels(1)
            done += number
        elif data[at + 1] == 0:  # end of a row
            at += 2
        elif data[at + 1] == 1:
            at += 2
            number = room(count())
            if not number:
                break
            if done < width:
                raise ValueError("there is no row above the first")
            while number:  # a copy that is longer than a row copies what it wrote
                part = min(number, width)
                out[done : done + part] = out[done - width : done - width + part]
                done, number = done + part, number - part
        else:
            at += 1
            number = room(count())
            out[done : done + number] = pixels(number)
            done += number
    if done != len(out):
        raise ValueError("fewer pixels than the image has")
    return out.reshape(height, width)
