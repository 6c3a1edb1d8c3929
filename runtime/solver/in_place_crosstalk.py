"""Crosstalk between pixels in place: a sub-pixel's phase as a weighted sum over its pixel and the neighbours."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from runtime.lightpath.light_path import LightPath
from runtime.solver.array_backend import Backend
from runtime.solver.iris_band import Band

Array = Any


class Crosstalk:
    """The sub-pixels of a panel with crosstalk: their phases, and where they lie within the pixel.

    Attributes
    ----------
    down : list of complex array [n, 1]
        For each row of sub-pixels, the linear phase over the band's rows that puts it at its place.
    across : list of complex array [m]
        The same for each column of sub-pixels, over the band's columns.
    columns, mixed, driven, one, back, room : array
        Room to work in.
    """

    def __init__(self, path: LightPath, rows: Band, columns: Band, backend: Backend) -> None:
        assert path.crosstalk is not None
        xp, grid = backend.xp, path.grid
        pair, real = path.source.dtype, path.response.dtype
        self.xp = xp
        self.taps_down, self.taps_across = (np.asarray(t, float).tolist() for t in path.crosstalk)
        self.down = [
            xp.asarray(turn.astype(pair)[:, None])
            for turn in _places(rows.frequencies / grid.padded[0], path.aperture[0], len(self.taps_down))
        ]
        self.across = [
            xp.asarray(turn.astype(pair))
            for turn in _places(columns.frequencies / grid.padded[1], path.aperture[1], len(self.taps_across))
        ]
        self.columns = xp.zeros((grid.padded[0], len(columns.frequencies)), pair)
        self.mixed, self.driven, self.one, self.back, self.room = (
            xp.zeros(grid.shape, real) for _ in range(5)
        )

    def mix_down(self, phase: Array, i: int) -> Array:
        """Phase mixed along columns for the sub-pixels of row i; valid until the next call."""
        self._mix(phase, self.taps_down[i], self.mixed, self.room)
        return self.mixed

    def mix_across(self, phase: Array, j: int) -> Array:
        """The same along rows for the sub-pixels of column j."""
        self._mix(phase.T, self.taps_across[j], self.driven.T, self.room.T)
        return self.driven

    def unmix_down(self, gradient: Array, i: int, total: Array) -> None:
        """Adjoint of `mix_down`, added to `total`."""
        self._unmix(gradient, self.taps_down[i], total, self.room)

    def unmix_across(self, gradient: Array, j: int, total: Array) -> None:
        """Adjoint of `mix_across`, added to `total`."""
        self._unmix(gradient.T, self.taps_across[j], total.T, self.room.T)

    def _mix(self, x: Array, taps: list[float], out: Array, room: Array) -> None:
        reach = len(taps) // 2
        self.xp.multiply(x, taps[reach], out=out)
        for k, tap in enumerate(taps):
            step = k - reach
            if step > 0:
                room[:-step], room[-step:] = x[step:], x[-1]
            elif step < 0:
                room[-step:], room[:-step] = x[:step], x[0]
            if step:
                room *= tap
                out += room

    def _unmix(self, gradient: Array, taps: list[float], total: Array, room: Array) -> None:
        reach = len(taps) // 2
        for k, tap in enumerate(taps):
            step = k - reach
            self.xp.multiply(gradient, tap, out=room)
            if step > 0:
                total[step:] += room[:-step]
                total[-1] += room[-step:].sum(0)
            elif step < 0:
                total[:step] += room[-step:]
                total[0] += room[:-step].sum(0)
            else:
                total += room


def _places(cycles: np.ndarray, aperture: float, count: int) -> list[np.ndarray]:
    """exp(-2 pi i f x) for each of `count` sub-pixels across the pixel's active area; f in cycles a pixel."""
    places = float(aperture) * ((np.arange(count) + 0.5) / count - 0.5)
    return [np.exp(-2j * math.pi * cycles * x) for x in places]
