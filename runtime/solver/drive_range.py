"""The phases that a panel can be driven to, and the gray levels that do it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath
from runtime.solver.array_backend import Backend
from runtime.solver.chosen_backend import backend

Array = Any

TURN_STEPS = 1 << 16  # of the table that rounds a phase to its gray level


class DriveRange:
    """The phases that a light path's panel reaches.

    Parameters
    ----------
    path : LightPath
    levels : int
        Gray levels that may be used, from 0 on; at most those that the response and the panel have.
    on : Backend or None
        Where the phases are that it is asked about; None: NumPy's arrays.

    Attributes
    ----------
    low, high : float or float array [H, W], rad
        The ends of the range.
    sorted : float array [levels], rad
        Phases of the gray levels, without a pixel's own gain, in the host's memory.
    gapless : bool
        A whole turn is covered everywhere.
    bounded : bool
        Phases a turn apart do not act the same, so a step has to stay in range.

    Raises
    ------
    InputError
        For a number of levels that is not from 2 to 256.
    """

    def __init__(self, path: LightPath, levels: int = 256, on: Backend | None = None) -> None:
        self.on = on or backend("numpy")
        xp = self.on.xp
        if not 2 <= levels <= 256:
            raise InputError(f"{levels} gray levels: give from 2 to 256")
        grays = np.arange(min(levels, len(path.response)))
        if path.gray_levels:
            grays = np.array([gray for gray in path.gray_levels if gray < levels])
        response = np.asarray(path.response)[grays]
        self.sorted = np.sort(response)
        self.order = xp.asarray(grays[np.argsort(response)].astype(np.uint8))
        self.between = xp.asarray((self.sorted[1:] + self.sorted[:-1]) / 2)
        self.gain = None if path.gain is None else xp.asarray(np.maximum(path.gain, 1e-3))
        low, high = self.sorted[0], self.sorted[-1]
        self.low = low if self.gain is None else self.gain * low
        self.high = high if self.gain is None else self.gain * high
        step = (high - low) / (len(response) - 1)
        # Where a whole turn is covered, phases beyond the ends come back inside; one step is no gap.
        gap = 2 * math.pi - float((self.high - self.low).min())
        self.gapless = bool(gap <= 1.5 * step)
        self.bounded = path.crosstalk is not None or path.modulation is not None or not self.gapless
        self.table = None
        if self.gain is None and not self.bounded:
            turn = xp.arange(TURN_STEPS, dtype=response.dtype) * (2 * math.pi / TURN_STEPS)
            self.table = self._nearest(turn)

    def held(self, phase: Array) -> Array:
        """Phases (rad) moved by whole turns into the panel's range; in a gap, to its nearer edge."""
        xp, turn = self.on.xp, 2 * math.pi
        above = (phase - self.low) / turn
        outside = (phase < self.low) | (phase > self.high)
        phase = xp.where(outside, phase - xp.floor(above) * turn, phase)
        past, before = phase - self.high, self.low + turn - phase  # how far it is from the two ends of a gap
        return xp.where(past <= 0, phase, xp.where(past <= before, self.high, self.low))

    def pushed_out(self, phase: Array, gradient: Array) -> Array:
        """Where a phase is at an end of the range and a step down the gradient would leave it, bool [H, W]."""
        return ((phase <= self.low) & (gradient > 0)) | ((phase >= self.high) & (gradient < 0))

    def gray(self, phase: Array, out: Array = None) -> Array:
        """Gray levels, uint8 [H, W], whose phase is nearest to `phase` (rad); written to `out` where given."""
        xp, table = self.on.xp, self.table
        out = xp.empty(phase.shape, np.uint8) if out is None else out
        if table is None:
            out[...] = self._nearest(phase)
            return out
        steps = phase.dtype.type(TURN_STEPS / (2 * math.pi))

        def work(worker: int, rows: slice) -> None:
            index = xp.rint(phase[rows] * steps).astype(np.int32)
            index &= TURN_STEPS - 1
            self.on.take(table, index, out[rows])

        size = max(1, self.on.strip_rows(phase.shape[1]) // 4)  # of three more arrays of its own
        self.on.over_rows(len(phase), size, work)
        return out

    def _nearest(self, phase: Array) -> Array:
        asked = self.held(phase)
        if self.gain is not None:
            asked = asked / self.gain
        return self.order[self.on.xp.searchsorted(self.between, asked)]
