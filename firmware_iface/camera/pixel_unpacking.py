"""Packed pixels of the camera (RAW10, GRAY8) unpacked to counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BIT_DEPTHS = {"raw10": 10, "gray8": 8}


def unpack(data: bytes, encoding: str, height: int, width: int, stride: int) -> NDArray[np.uint16]:
    """Unpack one picture.

    Parameters
    ----------
    data : bytes
    encoding : str
        "raw10" (MIPI: four pixels in five bytes, the fifth holds their low two bits, first pixel
        lowest) or "gray8".
    height, width : int, pixels
    stride : int
        Bytes from the start of one row to the next.

    Returns
    -------
    uint16 array [height, width], counts

    Raises
    ------
    ValueError
        Where the data does not hold such a picture.
    """
    if encoding not in BIT_DEPTHS:
        raise ValueError(f"pixels of encoding '{encoding}' are not known")
    if encoding == "raw10" and width % 4:
        raise ValueError(f"{width} pixels a row are not whole groups of four")
    row = width * 5 // 4 if encoding == "raw10" else width
    if height < 1 or width < 1 or stride < row or len(data) < stride * (height - 1) + row:
        raise ValueError(f"{len(data)} bytes do not hold {height} rows of {row} bytes, {stride} apart")
    rows = np.lib.stride_tricks.as_strided(
        np.frombuffer(data, np.uint8), (height, row), (stride, 1), writeable=False
    )
    if encoding == "gray8":
        return rows.astype(np.uint16)
    groups = rows.reshape(height, width // 4, 5).astype(np.uint16)
    low = groups[..., 4:] >> np.arange(0, 8, 2, dtype=np.uint16) & 3
    return np.asarray(groups[..., :4] << 2 | low, np.uint16).reshape(height, width)
