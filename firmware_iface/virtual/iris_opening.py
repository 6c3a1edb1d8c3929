"""Which spatial frequencies the iris of a simulated bench passes: outline, place, rotation, soft edge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.defects import Iris

Array = NDArray[np.float64]

PARTS = 8  # an axis, of a frequency that an edge cuts


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
    beyond : (float, float)
        How far beyond its half widths (y, x) the opening passes.
    """

    shape: str
    half: tuple[float, float]
    centre: tuple[float, float] = (0.0, 0.0)
    rotation_deg: float = 0.0
    soft_edge: float = 0.0
    beyond: tuple[float, float] = (0.0, 0.0)

    @property
    def _sides(self) -> tuple[float, float]:
        y, x = (half + more for half, more in zip(self.half, self.beyond, strict=True))
        return y, x

    @property
    def reach(self) -> float:
        """Greatest distance from the centre along either axis at which light passes.

        An opening within the panel's own band stays there.
        """
        (y, x), turn = self._sides, np.deg2rad(self.rotation_deg)
        if max(self.half) <= 1:
            y, x = min(y, 1.0), min(x, 1.0)
        cos, sin = abs(np.cos(turn)), abs(np.sin(turn))
        if self.shape == "circle":
            across, along = np.hypot(x * cos, y * sin), np.hypot(x * sin, y * cos)
        else:
            across, along = x * cos + y * sin, x * sin + y * cos
        return float(max(across, along)) + self.soft_edge / 2

    def mask(self, fy: Array, fx: Array) -> Array:
        """Amplitude that passes, [Fy, Fx], at evenly spaced frequencies [Fy] and [Fx] in shares of the band.

        A sharp edge passes each frequency by the share of its area that lies inside: as steps it would be an edge that
        no iris has, and err six times as much as the padding does.
        """
        outside = self._outside(fy[:, None], fx[None, :])
        if self.soft_edge:
            return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip(0.5 + outside / self.soft_edge, 0, 1)))
        passed = np.asarray(outside <= 0, np.float64)
        high, wide = (float(f[-1] - f[0]) / max(len(f) - 1, 1) for f in (fy, fx))
        rows, columns = np.nonzero(np.abs(outside) < 2 * max(high, wide))  # all that the edge can cut
        parts = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        v, u = fy[rows, None, None] + high * parts[:, None], fx[columns, None, None] + wide * parts
        passed[rows, columns] = (self._outside(v, u) <= 0).mean((1, 2))
        return passed

    def _outside(self, fy: Array, fx: Array) -> Array:
        """Distance beyond the edge, in shares of the band; negative inside."""
        v, u = fy - self.centre[0], fx - self.centre[1]
        if self.rotation_deg:
            turn = np.deg2rad(self.rotation_deg)
            u, v = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
        y, x = np.abs(v), np.abs(u)
        high, wide = self._sides
        if self.shape != "circle":
            return np.asarray(np.maximum(y - high, x - wide))
        if high == wide:
            return np.asarray(np.hypot(y, x) - high)
        # near an ellipse, a distance with the mean of its scales
        return np.asarray((np.hypot(y / high, x / wide) - 1) * np.sqrt(high * wide))


def iris_opening(bench: BenchDescription) -> IrisOpening:
    """The bench's true opening: the defect's, or the nominal one.

    A rectangle with sharp edges passes the frequencies on them whole: those of the panel padded to twice its size.
    """
    d = bench.defect(Iris)
    if d is None:
        opening = IrisOpening(bench.iris.shape, (bench.iris.half_width, bench.iris.half_width))
    else:
        opening = IrisOpening(
            d.shape or bench.iris.shape,
            (d.half_width_y or d.half_width, d.half_width_x or d.half_width),
            (d.centre_y_share, d.centre_x_share),
            d.rotation_deg,
            d.soft_edge_share,
        )
    if opening.shape == "circle" or opening.soft_edge:
        return opening
    return replace(opening, beyond=(0.5 / bench.panel.height, 0.5 / bench.panel.width))
