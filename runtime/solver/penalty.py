"""Penalties: how far light is from a target, and the slope of that, with the scale in closed form.

The light is compared up to one scale c, which is eliminated: for each pattern it has its best value, up to a limit, as
a pattern that loses its light would be nearer to any picture. A penalty
works on strips, in place. `measure` prepares `light` and returns the sums from which `scale` finds c; `slope`
then turns it into the loss's gradient over light and returns (loss, squared error of amplitude).

A floor, a share of the mean light, is added under every square root, whose slope is unbounded in the dark.
"""

from __future__ import annotations

from typing import Any

Array = Any
Sums = tuple[float, ...]

FLOOR = 1e-4  # of the mean light
ROUNDING = 1e-2  # of the root mean square amplitude: below it, l1 is rounded off


class Amplitude:
    """sum w (c sqrt(I) - sqrt(t))^2: Chakravarthula et al. 2020, eq. 14, with f the squared error of amplitude."""

    def __init__(self, xp: Any) -> None:
        self.xp = xp

    def measure(self, light: Array, wanted: Array, weight: Array | None, floor: float) -> Sums:
        """`light` becomes its square root; `wanted` is the target's."""
        xp = self.xp
        xp.maximum(light, 0, out=light)
        light += floor
        xp.sqrt(light, out=light)
        return _dots(xp, light, wanted, weight)

    @staticmethod
    def scale(sums: Sums, most: float) -> float:
        """c, from the summed results of `measure`, up to `most`, a factor on amplitude."""
        return min(sums[0] / max(sums[1], 1e-30), most)

    def slope(self, root: Array, wanted: Array, weight: Array | None, scale: float, error: Array) -> Sums:
        """`root`, from `measure`, becomes dLoss / dI; `error` is room."""
        xp = self.xp
        xp.multiply(root, scale, out=error)
        error -= wanted
        square = _squares(xp, error, weight)
        xp.divide(error, root, out=root)
        root *= scale
        if weight is not None:
            root *= weight
        return square, square

    @staticmethod
    def curvature(scale: float, light: float, rms_error: float) -> float:
        """Approximate second derivative over a pixel's phase, which a first step is divided by.

        A change of phase moves the field sideways as often as along itself, so it is half of that over |z|.

        Parameters
        ----------
        scale : float
            c.
        light : float
            Mean irradiance.
        rms_error : float
            Of amplitude.

        Returns
        -------
        float
        """
        return scale**2


class SmoothL1(Amplitude):
    """sum w |c sqrt(I) - sqrt(t)|, rounded off near zero so that it has a slope everywhere."""

    def slope(self, root: Array, wanted: Array, weight: Array | None, scale: float, error: Array) -> Sums:
        xp = self.xp
        xp.multiply(root, scale, out=error)
        error -= wanted
        square = _squares(xp, error, weight)
        size = xp.sqrt(error * error + ROUNDING**2)
        loss = float(size.sum()) if weight is None else float((size * weight).sum())
        xp.divide(error, root, out=root)
        root /= size
        root *= scale / 2
        if weight is not None:
            root *= weight
        return loss, square

    @staticmethod
    def curvature(scale: float, light: float, rms_error: float) -> float:
        return scale**2 / (2 * max(rms_error, ROUNDING))


class Irradiance(Amplitude):
    """sum w (c I - t)^2."""

    def measure(self, light: Array, wanted: Array, weight: Array | None, floor: float) -> Sums:
        """`light` stays; `wanted` is the target itself."""
        return _dots(self.xp, light, wanted, weight)

    @staticmethod
    def scale(sums: Sums, most: float) -> float:
        return Amplitude.scale(sums, most**2)

    def slope(self, light: Array, wanted: Array, weight: Array | None, scale: float, error: Array) -> Sums:
        xp = self.xp
        xp.multiply(light, scale, out=light)
        xp.maximum(light, 0, out=error)
        xp.sqrt(error, out=error)
        error -= xp.sqrt(wanted)
        square = _squares(xp, error, weight)
        light -= wanted
        loss = _squares(xp, light, weight)
        light *= 2 * scale
        if weight is not None:
            light *= weight
        return loss, square

    @staticmethod
    def curvature(scale: float, light: float, rms_error: float) -> float:
        return 4 * scale**2 * light


PENALTIES: dict[str, type[Amplitude]] = {"amplitude": Amplitude, "irradiance": Irradiance, "l1": SmoothL1}


def _dots(xp: Any, a: Array, b: Array, weight: Array | None) -> Sums:
    """Sums of a b and a a."""
    if weight is None:
        return float(xp.einsum("ij,ij->", a, b)), float(xp.einsum("ij,ij->", a, a))
    return float(xp.einsum("ij,ij,ij->", a, b, weight)), float(xp.einsum("ij,ij,ij->", a, a, weight))


def _squares(xp: Any, a: Array, weight: Array | None) -> float:
    if weight is None:
        return float(xp.einsum("ij,ij->", a, a))
    return float(xp.einsum("ij,ij,ij->", a, a, weight))
