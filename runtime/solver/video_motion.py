"""Motion in a video: how far content has moved between frames, and the frame before moved as its content."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from runtime.lightpath import fft

Array = Any

CUT = 0.7  # of the contrast: a frame that differs by more from the one before, moved, is another scene
PATCH = 512  # pixels: side of the part that motion is found in


def shifted(before: Array, motion: tuple[int, int], out: Array) -> None:
    """`before` [..., H, W] moved by (down, right) pixels into `out`; what leaves one side comes in at the other."""
    height, width = before.shape[-2:]
    dy, dx = motion[0] % height, motion[1] % width
    for to_rows, from_rows in (
        (slice(dy, None), slice(0, height - dy)),
        (slice(0, dy), slice(height - dy, None)),
    ):
        for to, of in ((slice(dx, None), slice(0, width - dx)), (slice(0, dx), slice(width - dx, None))):
            out[..., to_rows, to] = before[..., from_rows, of]


def renewed(motion: tuple[int, int], edges: tuple[int, int], shape: tuple[int, int]) -> list[tuple[Any, ...]]:
    """The parts of a panel [..., H, W] that are not moved with the content, but get a start of their own.

    Where content comes in, the frame before has nothing for it. Along its edges a pattern compensates for the
    panel's end, which does not move. Moved, both grow into speckle within a few frames.

    Parameters
    ----------
    motion : (int, int), pixels
        Of the content: down, right.
    edges : (int, int), pixels
        How far in the panel's end acts: rows, columns.
    shape : (int, int), pixels

    Returns
    -------
    list of index
    """
    parts: list[tuple[Any, ...]] = []
    for axis, (step, edge, count) in enumerate(zip(motion, edges, shape, strict=True)):
        first, last = (min(max(edge, way * step), count) for way in (1, -1))
        for part in (slice(0, first), slice(count - last, count)):
            if part.stop > part.start:
                parts.append((..., part, slice(None)) if axis == 0 else (..., part))
    return parts


def motion_between(before: Array, after: Array) -> tuple[int, int]:
    """How far content has moved as a whole from one picture to the next, by phase correlation of their middle.

    Parameters
    ----------
    before, after : float array [H, W]

    Returns
    -------
    (int, int), pixels
        Down, right; at most a quarter of the middle part, else (0, 0).

    References
    ----------
    Kuglin and Hines 1975.
    """
    first = [(n - min(n, PATCH)) // 2 for n in before.shape]
    patch = tuple(slice(f, f + min(n, PATCH)) for f, n in zip(first, before.shape, strict=True))
    shape = tuple(p.stop - p.start for p in patch)
    xp = array_namespace(after)
    down, across = (xp.asarray(np.hanning(n)) for n in shape)
    edge = down[:, None] * across
    a, b = (fft.rfft2((x[patch] - x[patch].mean()) * edge) for x in (before, after))
    cross = b * xp.conj(a)
    size = xp.abs(cross)
    peak = fft.irfft2(cross / xp.maximum(size, 1e-12 * size.max() + 1e-300), shape)
    place = np.unravel_index(int(xp.argmax(peak)), shape)
    moved = [int(p) - n if p > n // 2 else int(p) for p, n in zip(place, shape, strict=True)]
    if any(abs(m) > n // 4 for m, n in zip(moved, shape, strict=True)):
        return 0, 0
    return moved[0], moved[1]


def is_cut(before: Array, after: Array, motion: tuple[int, int]) -> bool:
    """Whether a picture [H, W] is of another scene than the one before, moved."""
    step = max(1, min(before.shape) // 64)
    moved = array_namespace(before).roll(
        before[::step, ::step], tuple(round(m / step) for m in motion), (0, 1)
    )
    now = after[::step, ::step]
    contrast = max(float(now.std()), float(moved.std()), 1e-12)
    return math.sqrt(float(((now - moved) ** 2).mean())) > CUT * contrast
