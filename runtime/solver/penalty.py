"""Penalties: how far light is from a target, and the slope of that, with the scale in closed form.

The light is compared up to one scale c, which is eliminated: for each pattern it has its best value, up to a limit, as
a pattern that loses its light would be nearer to any picture. A penalty
works on strips, in place. `measure` prepares `light` and returns the sums from which `scale` finds c; `slope`
then turns it into the loss's gradient over light and returns (loss, squared error of amplitude).

A floor, a share of the mean light, is added under every square root, whose slope is unbounded in the dark.
"""

from __future__ import annotations

from runtime.solver.array_backend import Array, Backend, Number

Sums = tuple[Number, ...]

FLOOR = 1e-4  # of the mean light
ROUNDING = 1e-2  # of the root mean square amplitude: below it, l1 is rounded off


class Amplitude:
    """sum w (c sqrt(I) - sqrt(t))^2: Chakravarthula et al. 2020, eq. 14, with f the squared error of amplitude."""

    def __init__(self, backend: Backend) -> None:
        self.backend, self.xp = backend, backend.xp

    def measure(self, light: Array, wanted: Array, weight: Array | None, floor: Number) -> Sums:
        """`light` becomes its square root; `wanted` is the target's."""
        xp = self.xp
        xp.maximum(light, 0, out=light)
        light += floor
        xp.sqrt(light, out=light)
        return self._dots(light, wanted, weight)

    def scale(self, sums: Sums, most: Number) -> Number:
        """c, from the summed results of `measure`, up to `most`, a factor on amplitude."""
        xp = self.xp
        return self.backend.number(xp.minimum(sums[0] / xp.maximum(sums[1], 1e-30), most))

    def slope(self, root: Array, wanted: Array, weight: Array | None, scale: Number, error: Array) -> Sums:
        """`root`, from `measure`, becomes dLoss / dI; `error` is room."""
        xp = self.xp
        xp.multiply(root, scale, out=error)
        error -= wanted
        square = self.backend.dot(error, error, weight)
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

    def _dots(self, light: Array, wanted: Array, weight: Array | None) -> Sums:
        return self.backend.dot(light, wanted, weight), self.backend.dot(light, light, weight)


class SmoothL1(Amplitude):
    """sum w |c sqrt(I) - sqrt(t)|, rounded off near zero so that it has a slope everywhere."""

    def slope(self, root: Array, wanted: Array, weight: Array | None, scale: Number, error: Array) -> Sums:
        xp = self.xp
        xp.multiply(root, scale, out=error)
        error -= wanted
        square = self.backend.dot(error, error, weight)
        size = xp.sqrt(error * error + ROUNDING**2)
        loss = self.backend.total(size if weight is None else size * weight)
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

    def measure(self, light: Array, wanted: Array, weight: Array | None, floor: Number) -> Sums:
        """`light` stays; `wanted` is the target itself."""
        return self._dots(light, wanted, weight)

    def scale(self, sums: Sums, most: Number) -> Number:
        return super().scale(sums, most**2)

    def slope(self, light: Array, wanted: Array, weight: Array | None, scale: Number, error: Array) -> Sums:
        xp = self.xp
        xp.multiply(light, scale, out=light)
        xp.maximum(light, 0, out=error)
        xp.sqrt(error, out=error)
        error -= xp.sqrt(wanted)
        square = self.backend.dot(error, error, weight)
        light -= wanted
        loss = self.backend.dot(light, light, weight)
        light *= 2 * scale
        if weight is not None:
            light *= weight
        return loss, square

    @staticmethod
    def curvature(scale: float, light: float, rms_error: float) -> float:
        return 4 * scale**2 * light


PENALTIES: dict[str, type[Amplitude]] = {"amplitude": Amplitude, "irradiance": Irradiance, "l1": SmoothL1}
