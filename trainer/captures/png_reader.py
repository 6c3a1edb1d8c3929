"""Gray PNG pictures, read whole or not at all."""

from __future__ import annotations

import io
import zlib
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from firmware_iface.errors import InputError
from trainer.captures.kept_pictures import kept_or_read

PNG_END = b"\0\0\0\0IEND\xae\x42\x60\x82"


class PictureError(InputError):
    """A picture that cannot be used.

    Attributes
    ----------
    kind : str
        missing_file, unreadable, bit_depth or wrong_size.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def read_picture(path: Path, shape: tuple[int, int], bits: int, what: str) -> np.ndarray:
    """A gray PNG, whole or not at all.

    Parameters
    ----------
    path : Path
    shape : (int, int), pixels
        The height and width that it must have.
    bits : int
        8, 16, or 0 where both are allowed.
    what : str
        How messages name it.

    Returns
    -------
    uint8 array [height, width] when bits is 8, otherwise uint16
        Not writeable in a worker, which keeps it.

    Raises
    ------
    PictureError
        If it is missing, truncated or damaged, not gray of that depth, or of another size.
    """
    return kept_or_read(path, (tuple(shape), bits), lambda: _read(path, shape, bits, what))


def _read(path: Path, shape: tuple[int, int], bits: int, what: str) -> np.ndarray:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PictureError(
            "missing_file", f"{what} cannot be read at {path} ({error.strerror}): put the file back"
        ) from None
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            mode, size = picture.mode, (picture.size[1], picture.size[0])
            picture.verify()  # every chunk's checksum; decoding alone does not look at those of the pixels
    except (
        OSError,
        ValueError,
        SyntaxError,
        KeyError,
        IndexError,
        EOFError,
        zlib.error,
        MemoryError,
        Image.DecompressionBombError,
        OverflowError,
    ) as error:
        raise PictureError(
            "unreadable", f"{what} is not a whole PNG at {path} ({reason(error)}): write the file again"
        ) from None
    if PNG_END not in data:  # Pillow reads such a file without complaint
        raise PictureError("unreadable", f"{what} is cut off at its end at {path}: write the file again")
    depth = {"L": 8, "I;16": 16, "I;16B": 16, "I": 16}.get(mode)
    if depth is None or (bits and depth != bits):
        kind = f"{depth}-bit gray" if depth else f"of mode {mode}"
        raise PictureError(
            "bit_depth" if depth else "unreadable",
            f"{what} at {path} is {kind}: save it as {bits or '8 or 16'}-bit gray PNG, unscaled",
        )
    if size != tuple(shape):
        raise PictureError(
            "wrong_size",
            f"{what} at {path} is {size[0]} x {size[1]} (height x width), but "
            f"bench.toml says {shape[0]} x {shape[1]}: correct the file or bench.toml",
        )
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            picture.load()
            pixels = np.array(picture)
    except (
        OSError,
        ValueError,
        SyntaxError,
        KeyError,
        IndexError,
        EOFError,
        zlib.error,
        MemoryError,
        OverflowError,
    ) as error:
        raise PictureError(
            "unreadable", f"{what} is not a whole PNG at {path} ({reason(error)}): write the file again"
        ) from None
    return pixels.astype(np.uint8 if bits == 8 else np.uint16, copy=False)


def reason(error: BaseException) -> str:
    """What a library's error says, in one short line and without its objects."""
    if isinstance(error, UnidentifiedImageError):
        return "it is something else, or damaged"
    return (str(error).splitlines() or [type(error).__name__])[0][:120]
