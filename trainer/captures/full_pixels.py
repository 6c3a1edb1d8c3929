"""Pixels that are full below the camera's top count, so that none is ever saturated.

A picture's brightest pixels then all count alike, where speckle's differ by half. So do those of every other picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trainer.captures.bench_file import Camera
from trainer.captures.problems import Problem

SOME, FEW = 2e-3, 1e-4  # shares of the pixels: brighter than all others, and of these the brightest
# Counts of the FEW over those of SOME below which pixels may be full, and below which they are: of speckle, about 1.5.
MAYBE, SURELY = 1.15, 1.05
TOP = 0.93  # share of full scale beyond which it is the top count that they may have reached
# In a set with full pixels, so many of the patterns have them, and of their brightest counts the least is this share.
MOST, SAME = 0.75, 0.95


def brightest(counts: NDArray[np.uint16], camera: Camera) -> float:
    """Counts above black that SOME of a picture's pixels reach, as a share of full scale."""
    return float(np.quantile(counts, 1 - SOME) - camera.black_level) / camera.full_scale


def may_be_full(counts: NDArray[np.uint16], camera: Camera, alike: float = MAYBE) -> bool:
    """Whether a picture's brightest pixels all count alike, below the top count."""
    top = float(np.quantile(counts, 1 - FEW) - camera.black_level) / camera.full_scale
    return top < min(alike * brightest(counts, camera), TOP)


def check_full(full: Sequence[float], patterns: int) -> list[Problem]:
    """Whether pixels of a set are full below the top count.

    Parameters
    ----------
    full : sequence of float
        `brightest` of each pattern with pixels that are SURELY alike.
    patterns : int
        How many there are.
    """
    if len(full) < max(3, MOST * patterns) or min(full) < SAME * max(full):
        return []
    return [
        Problem(
            "warning",
            "saturated",
            "",
            f"the brightest pixels of {len(full)} of {patterns} patterns all count {100 * max(full):.0f} % of full "
            "scale: they seem to be full, or a curve in the camera's software ends there. Take the captures again with "
            "less light",
        )
    ]
