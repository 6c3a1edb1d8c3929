"""Small pictures of differences, as data URIs: blue below zero, white at it, orange above."""

from __future__ import annotations

import numpy as np
from PIL import Image

from trainer.report.png_uri import png_uri
from trainer.studio.colours import LEVELS, MISSING, difference_palette


def difference_uri(values: np.ndarray, scale: float) -> str:
    """A PNG of differences; NaN is gray.

    Parameters
    ----------
    values : array [h, w]
    scale : float
        Value at the end of the colours.
    """
    palette = difference_palette()
    index = np.full(values.shape, LEVELS, dtype=np.uint8)
    finite = np.isfinite(values)
    top = len(palette) - 1
    index[finite] = np.clip(np.rint((values[finite] / (2 * max(scale, 1e-12)) + 0.5) * top), 0, top).astype(
        np.uint8
    )
    picture = Image.fromarray(index)
    colours = [int(c[k : k + 2], 16) for c in (*palette, MISSING) for k in (1, 3, 5)]
    picture.putpalette(colours)
    return png_uri(picture)
