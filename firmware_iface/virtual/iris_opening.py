"""Which spatial frequencies the iris of a simulated bench passes: outline, place, rotation, soft edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.defects import Iris

Array = NDArray[np.float64]

SAMPLES_ACROSS = 8  # an axis, of a frequency that an edge cuts


@dataclass(frozen=True)
class IrisOpening:
    """The opening, in shares of the panel's band 1 / (2 pitch).

    Attributes
    ----------
    shape : str
        "square" or "circle"; with unequal half widths an oblong or an ellipse.
    half : (float, float)
        Half widths (y, x).
    centre : (float, float)
        (y, x).
    rotation_deg : float, deg
        From x towards y, about the centre.
    soft_edge : float
        Width of the edge, half of it outside.
    """

    shape: str
    half: tuple[float, float]
    centre: tuple[float, float] = (0.0, 0.0)
    rotation_deg: float = 0.0
    soft_edge: float = 0.0

    @property
    def reach(self) -> float:
        """Greatest distance from the centre along either axis at which light passes."""
        (y, x), turn = self.half, np.deg2rad(self.rotation_deg)
        cos, sin = abs(np.cos(turn)), abs(np.sin(turn))
        if self.shape == "circle":
            across, along = np.hypot(x * cos, y * sin), np.hypot(x * sin, y * cos)
        else:
            across, along = x * cos + y * sin, x * sin + y * cos
        return float(max(across, along)) + self.soft_edge / 2

    def mask(self, fy: Array, fx: Array) -> Array:
        """Amplitude that passes, [Fy, Fx], at evenly spaced frequencies [Fy] and [Fx] in shares of the band.

        A frequency on the edge of an upright rectangle passes. A sharp edge that runs across the samples passes each
        by the share of its area that lies inside: as steps it would be an edge that no iris has, and err six times
        as much as the padding does.
        """
        steps = SAMPLES_ACROSS if self._runs_across and self.soft_edge == 0 else 1
        parts_y, parts_x = (_parts(f, steps) for f in (fy, fx))
        passed = [self._passed(v, u) for v in parts_y for u in parts_x]
        return np.asarray(sum(passed) / len(passed), np.float64)

    @property
    def _runs_across(self) -> bool:
        """Whether the edge runs aslant to the axes."""
        return self.shape == "circle" or self.rotation_deg % 90 != 0

    def _passed(self, fy: Array, fx: Array) -> Array:
        v, u = (fy - self.centre[0])[:, None], (fx - self.centre[1])[None, :]
        if self.rotation_deg:
            turn = np.deg2rad(self.rotation_deg)
            u, v = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
        y, x = np.abs(v), np.abs(u)
        high, wide = (half * (1 + 1e-9) + 1e-12 for half in self.half)
        if self.shape != "circle":
            outside = np.maximum(y - high, x - wide)
        elif high == wide:
            outside = np.hypot(y, x) - high
        else:  # near an ellipse, a distance with the mean of its scales
            outside = (np.hypot(y / high, x / wide) - 1) * np.sqrt(high * wide)
        if self.soft_edge == 0:
            return np.asarray(outside <= 0, np.float64)
        ramp = np.clip(0.5 + outside / self.soft_edge, 0, 1)
        return np.asarray(0.5 + 0.5 * np.cos(np.pi * ramp))


def _parts(f: Array, steps: int) -> list[Array]:
    """Frequencies `f` moved to the centres of each of `steps` parts of a sample."""
    width = (f[-1] - f[0]) / max(len(f) - 1, 1)
    return [f + width * ((k + 0.5) / steps - 0.5) for k in range(steps)]


def iris_opening(bench: BenchDescription) -> IrisOpening:
    """The bench's true opening: the defect's, or the nominal one."""
    d = bench.defect(Iris)
    if d is None:
        return IrisOpening(bench.iris.shape, (bench.iris.half_width, bench.iris.half_width))
    return IrisOpening(
        d.shape or bench.iris.shape,
        (d.half_width_y or d.half_width, d.half_width_x or d.half_width),
        (d.centre_y_share, d.centre_x_share),
        d.rotation_deg,
        d.soft_edge_share,
    )
