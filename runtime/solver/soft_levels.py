"""A panel's few levels inside the descent: phases rounded to them softly, more sharply stage by stage.

Where a panel has 16 levels, rounding after the descent loses several dB. A rounding with a slope lets the descent
see the levels: it begins almost as the identity, ends almost as the steps, and the patterns of a picture make up for
one another's rounding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.solver.array_backend import Backend
from runtime.solver.drive_range import DriveRange

Array = Any

FEW = 64  # levels a turn; of four patterns, rounding at the end loses 4 dB at 8, 1.7 at 16, 0.2 at 64, 0.1 at 128
SHARPNESS = (1.0, 2.0, 4.0, 8.0, 16.0)  # one stage each: fewer, or twice as many, were worse
# One pattern has no other to make up for its rounding: soft levels pay up to 16 a turn, and in few stages.
FEW_ALONE = 16  # at 32, rounding at the end is ahead until 40 iterations
SHARPNESS_ALONE = (1.0, 6.0)  # ahead of rounding from one iteration on; the five stages only from six on
SAME = 1e-4  # rad: levels nearer than this are one


class SoftLevels:
    """Rounding of phases to the levels of their panels, with its slope.

    Parameters
    ----------
    drives : sequence of DriveRange
        Of the patterns.
    shape : (int, int, int)
        Patterns, H, W.
    rows : int
        Of a strip.
    backend : Backend
    stages : tuple of float
        Sharpness of the stages of a descent.

    Attributes
    ----------
    sharpness : float
        Near 0: phases stay as they are; infinite: they are rounded.
    phase, slope : float array [patterns, H, W]
        What `round` fills: rounded phase (rad), and its derivative over the phase.

    References
    ----------
    Agustsson and Theis 2020, section 4.1.
    """

    def __init__(
        self,
        drives: Sequence[DriveRange],
        shape: tuple[int, ...],
        rows: int,
        backend: Backend,
        stages: tuple[float, ...] = SHARPNESS,
    ) -> None:
        xp = backend.xp
        real = drives[0].sorted.dtype
        self.backend, self.rows, self.stages, self.sharpness = backend, rows, stages, stages[0]
        self.phase, self.slope = xp.zeros(shape, real), xp.zeros(shape, real)
        self.drives = drives
        self.levels = [xp.asarray(distinct(drive.sorted)) for drive in drives]
        self.gains = [xp.asarray(np.ones((1, 1), real) if d.gain is None else d.gain) for d in drives]

    def round(self, phase: Array) -> None:
        """Fill `phase` and `slope` from phases (rad) [patterns, H, W], at the present sharpness."""
        for n in range(len(phase)):

            def work(worker: int, rows: slice, n: int = n) -> None:
                self._round(n, phase[n, rows], rows)

            self.backend.over_rows(phase.shape[1], self.rows, work)

    def _round(self, n: int, phase: Array, rows: slice) -> None:
        xp, levels = self.backend.xp, self.levels[n]
        gain = self.gains[n] if len(self.gains[n]) == 1 else self.gains[n][rows]
        turn, low, high = 2 * math.pi / gain, levels[0], levels[-1]
        asked = phase / gain
        outside = (asked < low) | (asked > high)
        asked = xp.where(outside, asked - turn * xp.floor((asked - low) / turn), asked)
        below = xp.clip(xp.searchsorted(levels, asked, side="right") - 1, 0, len(levels) - 1)
        # Above the highest level comes the lowest again, a turn on.
        above = xp.where(below + 1 < len(levels), levels[xp.minimum(below + 1, len(levels) - 1)], low + turn)
        gap = xp.maximum(above - levels[below], SAME)
        place = xp.clip((asked - levels[below]) / gap - 0.5, -0.5, 0.5)
        if math.isinf(self.sharpness):
            rounded, slope = xp.where(place < 0, -0.5, 0.5), xp.ones_like(place)
        else:
            full = 2 * math.tanh(self.sharpness / 2)
            bent = xp.tanh(self.sharpness * place)
            rounded, slope = bent / full, self.sharpness / full * (1 - bent * bent)
        self.phase[n, rows] = phase + gain * gap * (rounded - place)
        self.slope[n, rows] = slope


def distinct(phases: np.ndarray) -> np.ndarray:
    """Sorted phases (rad) without those that repeat the one before."""
    return phases[np.concatenate([[True], np.diff(phases) > SAME])]


def stages_of(drives: Sequence[DriveRange], frames: int) -> tuple[float, ...]:
    """Sharpness of each stage of a descent, for N patterns a picture; none where rounding at the end is as good."""
    few, stages = (FEW, SHARPNESS) if frames > 1 else (FEW_ALONE, SHARPNESS_ALONE)
    return stages if min(map(levels_a_turn, drives)) <= few else ()


def levels_a_turn(drive: DriveRange) -> int:
    """How many different phases a panel has within a turn, where phases a turn apart are the same."""
    turned = np.sort(drive.sorted.astype(float) % (2 * math.pi))
    apart = np.diff(turned, append=turned[0] + 2 * math.pi)
    return max(1, int(np.count_nonzero(apart > SAME)))
