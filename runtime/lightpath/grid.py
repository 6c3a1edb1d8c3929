"""The grid that a light path is sampled on: its sizes, its frequencies and its windows.

Irradiance is sampled twice as finely as the panel, because it has twice the bandwidth of the field; as finely as the
panel where the iris is NARROW, and four times where it is WIDE. The grid is zero-padded, so light that leaves one side
does not come back on the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import scipy.fft
from array_api_compat import array_namespace

from runtime.lightpath.periodic_axis import ring

Array = Any
Runs = list[tuple[int, int]]

FINE = 2  # samples of irradiance a panel pixel, an axis
COARSE, FINEST = 1, 4  # behind a narrow iris, and behind a wide one
# Half width up to which an iris is narrow. Between samples a pixel apart of a random phase's image, this share of its
# variance is missed: 3e-7 at 0.49, at 0.5 3e-5 of 240 x 320 pixels and 8e-6 of 480 x 640, 3e-4 at 0.505.
NARROW = 0.5
# Half width beyond which an iris is wide, as a share of the panel's band. Of 200 x 256 pixels with nothing wrong, two
# samples a pixel leave an excess of 0.0001 at 1, 0.0003 at 1.25, 0.0006 at 1.4 and 0.0017 at 1.9.
WIDE = 1.25
MARGIN = 24  # panel pixels beyond the panel's border for which irradiance is computed
# How near to midway between two frequency samples an iris's edge is to be, and how much larger a grid may be for that.
MIDWAY, MOST_LARGER = 0.25, 1.08


@dataclass(frozen=True)
class Grid:
    """Sizes of the sampled light path.

    Attributes
    ----------
    shape : (int, int), pixels
        Of the panel: rows, columns.
    padded : (int, int), pixels
        The same with room for light to spread.
    margin : int, pixels
        Panel pixels kept around the image, so that what follows (blur, shift) has light beyond its border.
    band : (int, int)
        The highest frequency index kept (rows, columns); index k is k / (padded * pitch) cycles/m.
    pitch : float, m
    fine : int
        Samples of irradiance a panel pixel, an axis; a power of two.
    """

    shape: tuple[int, int]
    padded: tuple[int, int]
    margin: int
    band: tuple[int, int]
    pitch: float
    fine: int = FINE

    @property
    def image_shape(self) -> tuple[int, int]:
        """Samples of the fine irradiance grid: the panel and its margin, `fine` samples a pixel."""
        return (self.fine * (self.shape[0] + 2 * self.margin), self.fine * (self.shape[1] + 2 * self.margin))

    @property
    def image_period(self) -> tuple[int, int]:
        """Samples of a whole period on the fine grid."""
        return self.fine * self.padded[0], self.fine * self.padded[1]

    @property
    def band_share(self) -> float:
        """Share of the panel's band 1 / (2 pitch) that is kept, along the axis that keeps more."""
        return max(2 * edge / n for edge, n in zip(self.band, self.padded, strict=True))

    def frequency_index(self, axis: int) -> list[int]:
        """Frequency indices of the band along an axis, lowest first."""
        return list(range(-self.band[axis], self.band[axis] + 1))


def grid_for(
    shape: tuple[int, int],
    pitch: float,
    wavelength: float,
    distance: float,
    half_width: float,
    margin: int = MARGIN,
    narrowest: float | None = None,
    stated: float | None = None,
) -> Grid:
    """The smallest grid that keeps the light path linear, or one not much larger that suits the iris.

    A ray at the edge of the iris moves sideways by lambda z half_width / (2 pitch) on its way. Six tenths more
    hold the tails of the aperture's own diffraction. (On a 240 x 320 panel at 30 mm the ideal model's held-out
    excess is 2.6e-4, 1.7e-4, 1.2e-4 and 0.9e-4 at 1.1, 1.25, 1.4 and 1.6 times that distance. 1.1 would be enough
    for a solver alone: 0.01 dB less at 540 x 960. It would not be enough for calibration.) Near the panel, the tails of
    the iris's own figure matter more, and these are the wider the smaller the iris is.

    Parameters
    ----------
    shape : (int, int), pixels
        Of the panel.
    pitch, wavelength, distance : float, m
    half_width : float
        Of the iris, as a share of the panel's band 1 / (2 pitch).
    margin : int, pixels
    narrowest : float or None
        Half width that the iris may be closed to; None: `half_width`.
    stated : float or None
        Half width that the iris has as a rule, where `half_width` leaves room for more; None: `half_width`.

    Returns
    -------
    Grid
    """
    walk = wavelength * abs(distance) * half_width / (2 * pitch**2)
    room = math.ceil(max(1.6 * walk, 2 * margin / min(narrowest or half_width, 1)))
    rows, columns = (_padded_size(n, n + room, stated or half_width) for n in shape)
    band = tuple(_band_edge(half_width, n, padded) for n, padded in zip(shape, (rows, columns), strict=True))
    fine = COARSE if half_width <= NARROW else FINEST if half_width > WIDE else FINE
    return Grid(shape, (rows, columns), margin, (band[0], band[1]), pitch, fine)


def beyond_edge(count: int) -> float:
    """How far beyond its half width a rectangular iris passes, as a share of the panel's band.

    Half a frequency sample of the panel, `count` pixels padded to twice as many: a frequency on the edge passes.
    """
    return 1 / (2 * count)


def passed_share(frequency: Array, side: Array | float, width: float) -> Array:
    """Share of each frequency sample along an axis that lies between the sides of a rectangular iris.

    A sample on an edge passes by the share of its width that lies inside. So the iris's size has a gradient, and what
    passes does not depend on the padding.

    Parameters
    ----------
    frequency : real array
        From the iris's centre; any unit.
    side : real array or float
        Half width of the iris with what it passes beyond (`beyond_edge`), in the same unit.
    width : float
        Of a sample, in the same unit.

    Returns
    -------
    real array
        0 to 1.
    """
    xp = array_namespace(frequency)
    return xp.clip((side - xp.abs(frequency)) / width + 0.5, 0, 1)


def _band_edge(half_width: float, count: int, padded: int) -> int:
    """The highest frequency index of which the iris passes a part."""
    edge = half_width * padded / 2 + max(beyond_edge(count) * padded / 2 - 0.5, 0.0)
    return min(math.ceil(edge), padded // 2 if half_width <= 1 else padded - 1)


def band_frequencies(grid: Grid, like: Array) -> tuple[Array, Array]:
    """Frequencies (cycles/m) of the band along y and x, in namespace and precision of the real `like`."""
    xp = array_namespace(like)
    fy, fx = (
        xp.asarray(grid.frequency_index(axis), dtype=like.dtype, device=like.device)
        / (grid.padded[axis] * grid.pitch)
        for axis in (0, 1)
    )
    return fy, fx


def image_frequencies(grid: Grid, like: Array) -> tuple[Array, Array]:
    """Frequencies (cycles/m) of the fine image grid's `rfft2`, along y and x."""
    xp = array_namespace(like)
    height, width = grid.image_shape
    step = grid.pitch / grid.fine
    kind = {"dtype": like.dtype, "device": like.device}
    fy = xp.asarray([k if k < (height + 1) // 2 else k - height for k in range(height)], **kind)
    fx = xp.arange(width // 2 + 1, **kind)
    return fy / (height * step), fx / (width * step)


def pixel_slices(grid: Grid) -> tuple[slice, slice]:
    """The samples of the fine image grid at the centres of the panel's pixels."""
    first, fine = grid.fine * grid.margin, grid.fine
    rows, columns = (slice(first, first + fine * n, fine) for n in grid.shape)
    return rows, columns


def at_pixels(grid: Grid, image: Array) -> Array:
    """Fine image at the centres of the panel's pixels: [..., *image_shape] to [..., H, W]."""
    rows, columns = pixel_slices(grid)
    return image[..., rows, columns]


def band_window(grid: Grid) -> tuple[Runs, Runs]:
    """Where the band lies on the panel's DFT: runs of rows, runs of columns."""
    return ring(-grid.band[0], 2 * grid.band[0] + 1, grid.padded[0]), ring(
        -grid.band[1], 2 * grid.band[1] + 1, grid.padded[1]
    )


def image_window(grid: Grid) -> tuple[Runs, Runs]:
    """Where the image lies on the period of the fine grid: runs of rows, runs of columns."""
    first = -grid.fine * grid.margin
    runs = [ring(first, n, period) for n, period in zip(grid.image_shape, grid.image_period, strict=True)]
    return runs[0], runs[1]


def _padded_size(count: int, least: int, half_width: float) -> int:
    """A size with a fast FFT along an axis of `count` pixels, at which the iris's edge lies between two samples.

    What light the iris spreads beyond the padding comes back on the other side. An edge on a sample makes it come back
    with the wrong sign, which errs up to four times as much as an edge midway: of 240 x 320 pixels at 40 mm behind half
    of the band 3.2e-4 of the variance with 378 x 450 samples, and 0.5e-4 with 384 x 480.
    """
    smallest = size = _even_fast_size(least)
    while size <= MOST_LARGER * smallest:
        edge = (half_width + beyond_edge(count)) * size / 2
        is_open = half_width <= 1 and edge >= size / 2
        if is_open or abs(edge % 1 - 0.5) <= MIDWAY:
            return size
        size = _even_fast_size(size + 1)
    return smallest


def _even_fast_size(n: int) -> int:
    size = scipy.fft.next_fast_len(n)
    while size % 2:
        size = scipy.fft.next_fast_len(size + 1)
    return size
