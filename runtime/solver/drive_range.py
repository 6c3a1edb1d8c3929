"""The phases that a panel can be driven to, and the gray levels that do it."""

from __future__ import annotations

import math

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath

TURN_STEPS = 1 << 16  # of the table that rounds a phase to its gray level
ROWS = 16  # rounded at a time


class DriveRange:
    """The phases that a light path's panel reaches.

    Parameters
    ----------
    path : LightPath
    levels : int
        Gray levels that may be used, from 0 on; at most those that the response and the panel have.

    Attributes
    ----------
    low, high : float or float array [H, W], rad
        The ends of the range.
    gapless : bool
        A whole turn is covered everywhere.
    bounded : bool
        Phases a turn apart do not act the same, so a step has to stay in range.

    Raises
    ------
    InputError
        For a number of levels that is not from 2 to 256.
    """

    def __init__(self, path: LightPath, levels: int = 256) -> None:
        if not 2 <= levels <= 256:
            raise InputError(f"{levels} gray levels: give from 2 to 256")
        grays = np.arange(min(levels, len(path.response)))
        if path.gray_levels:
            grays = np.array([gray for gray in path.gray_levels if gray < levels])
        response = np.asarray(path.response)[grays]
        self.order = grays[np.argsort(response)].astype(np.uint8)
        self.sorted = np.sort(response)
        self.between = (self.sorted[1:] + self.sorted[:-1]) / 2
        self.gain = None if path.gain is None else np.maximum(path.gain, 1e-3)
        low, high = self.sorted[0], self.sorted[-1]
        self.low = low if self.gain is None else low * self.gain
        self.high = high if self.gain is None else high * self.gain
        step = (high - low) / (len(response) - 1)
        # Where a whole turn is covered, phases beyond the ends come back inside; one step is no gap.
        gap = 2 * math.pi - np.min(self.high - self.low)
        self.gapless = bool(gap <= 1.5 * step)
        self.bounded = path.crosstalk is not None or path.modulation is not None or not self.gapless
        self.table = None
        if self.gain is None and not self.bounded:
            turn = np.arange(TURN_STEPS, dtype=response.dtype) * (2 * math.pi / TURN_STEPS)
            self.table = self._nearest(turn)

    def held(self, phase: np.ndarray) -> np.ndarray:
        """Phases (rad) moved by whole turns into the panel's range; in a gap, to its nearer edge."""
        turn = phase.dtype.type(2 * math.pi)
        above = (phase - self.low) / turn
        outside = (phase < self.low) | (phase > self.high)
        phase = np.where(outside, phase - turn * np.floor(above), phase)
        past = phase - self.high
        return np.where(past <= 0, phase, np.where(past <= self.low + turn - phase, self.high, self.low))

    def pushed_out(self, phase: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Where a phase is at an end of the range and a step down the gradient would leave it, bool [H, W]."""
        return ((phase <= self.low) & (gradient > 0)) | ((phase >= self.high) & (gradient < 0))

    def gray(self, phase: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Gray levels, uint8 [H, W], whose phase is nearest to `phase` (rad); written to `out` where given."""
        out = np.empty(phase.shape, np.uint8) if out is None else out
        if self.table is None:
            out[...] = self._nearest(phase)
            return out
        steps = phase.dtype.type(TURN_STEPS / (2 * math.pi))
        for first in range(0, len(phase), ROWS):
            rows = slice(first, first + ROWS)
            index = np.rint(phase[rows] * steps).astype(np.int32)
            index &= TURN_STEPS - 1
            np.take(self.table, index, out=out[rows], mode="clip")
        return out

    def _nearest(self, phase: np.ndarray) -> np.ndarray:
        asked = self.held(phase)
        if self.gain is not None:
            asked = asked / self.gain
        return self.order[np.searchsorted(self.between, asked)]
