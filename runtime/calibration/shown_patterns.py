"""The patterns that a headset shows itself: random grains, gratings, and a test picture."""

from __future__ import annotations

import numpy as np

GRAINS = (4, 2, 6, 3, 8, 2, 5, 3, 4, 2)  # pixels; coarse ones reach far, fine ones measure finely
HELD_OUT = (3, 5)


def grains(shape: tuple[int, int], size: int, seed: int) -> np.ndarray:
    """Squares of random gray levels.

    Their speckle fills the image, and moves and deforms with every error of the light path: the smaller the
    squares, the finer the speckle and the farther apart the places of the panel that meet in one of the image.

    Parameters
    ----------
    shape : (int, int)
        (H, W) of the panel, pixels.
    size : int, pixels
        Of the squares.
    seed : int

    Returns
    -------
    uint8 array [H, W]
    """
    rng = np.random.default_rng([seed, size])
    rows, columns = (-(-n // size) + 1 for n in shape)
    few = rng.integers(0, 256, (rows, columns), dtype=np.uint8)
    top, left = rng.integers(0, size, 2)
    large = np.repeat(np.repeat(few, size, 0), size, 1)
    return np.ascontiguousarray(large[top : top + shape[0], left : left + shape[1]])


def grating(shape: tuple[int, int], period: int, gray: int) -> np.ndarray:
    """A binary grating of gray 0 and `gray`, its lines `period` pixels apart along a row: uint8 [H, W].

    It is read only, and takes the memory of one row.
    """
    stripes = np.arange(shape[1]) % period >= period // 2
    return np.broadcast_to(np.where(stripes, gray, 0).astype(np.uint8), shape)


def proof_picture(shape: tuple[int, int]) -> np.ndarray:
    """A test picture for a display: bars, a ramp, discs, a star and darkness, irradiance 0.02 to 1, float32 [H, W]."""
    height, width = shape
    y, x = np.mgrid[:height, :width]
    v, u = y / height, x / width
    picture = np.full(shape, 0.02)
    picture[(v > 0.08) & (v < 0.92) & (u > 0.05) & (u < 0.95)] = 0.25
    for number, period in enumerate((12, 8, 6, 4)):
        box = (v > 0.14) & (v < 0.36) & (u > 0.1 + 0.13 * number) & (u < 0.21 + 0.13 * number)
        picture[box] = np.where((x % period < period / 2)[box], 0.9, 0.05)
    ramp = (v > 0.76) & (v < 0.86)
    picture[ramp & (u > 0.1) & (u < 0.9)] = (0.03 + (u - 0.1) * 1.2)[ramp & (u > 0.1) & (u < 0.9)]
    for row, column, radius, light in (
        (0.56, 0.2, 0.1, 1.0),
        (0.56, 0.4, 0.06, 0.6),
        (0.56, 0.53, 0.03, 1.0),
    ):
        picture[np.hypot((v - row) * height, (u - column) * width) < radius * height] = light
    away = np.hypot((v - 0.45) * height, (u - 0.77) * width)
    star = np.sin(12 * np.arctan2((v - 0.45) * height, (u - 0.77) * width)) > 0
    picture[away < 0.24 * height] = np.where(star, 0.8, 0.04)[away < 0.24 * height]
    return picture.astype(np.float32)
