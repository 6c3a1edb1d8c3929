"""The light path: from phase on the panel to irradiance in the image plane.

Written against the array API: the headset runs it on NumPy arrays, the trainer differentiates it. Its adjoint is
in `light_path_adjoint`. The one other copy, in place for solver and calibration, is `runtime.solver.in_place_path`.
All that a bench does to the light is in the arrays of a `LightPath`, for one colour and one plane:

    phi = gain * response[gray]                     drive (and, finer than a pixel, `crosstalk`)
    u   = source * m(phi) exp(j phi) + leak         panel, convolved with the pixel's aperture
    z_m = IFFT(FFT(u) * transfer_m)                 pupil, one transfer function a mode
    I   = filter * sum_m weight_m |z_m|^2           irradiance, on a grid twice as fine as the panel's

Arrays are [row, column]; leading axes are batches. The sizes are those of a `Grid` (`runtime.lightpath.grid`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from array_api_compat import array_namespace

from runtime.lightpath.crosstalk import mix_neighbours
from runtime.lightpath.fft import fft, ifft, irfft2, rfft2
from runtime.lightpath.grid import (
    Grid,
    at_pixels,
    band_frequencies,
    band_window,
    image_frequencies,
    image_window,
)
from runtime.lightpath.host_arrays import squared_modulus, unit_phasor
from runtime.lightpath.modulation import Modulation, factor_at
from runtime.lightpath.periodic_axis import take

Array = Any


@dataclass
class LightPath:
    """Everything a bench does to light of one colour on its way to one plane.

    Attributes
    ----------
    grid : Grid
    response : float array [levels], rad
        Phase of each gray level.
    gray_levels : tuple of int
        Those that the panel has, where it has few: the response of others is that of the nearest. Empty: all.
    source : complex array [H, W]
        The illuminating field.
    transfers : complex array [M, 2 band + 1, 2 band + 1]
        The pupil's modes.
    weights : float array [M]
        Of the modes.
    gain : float array [H, W] or None
        Factor on the phase over the panel.
    crosstalk : (float array [sub-pixels, taps], float array [sub-pixels, taps]) or None
        Phase of a sub-pixel as a weighted sum over the pixel and its neighbours, along rows and columns: (ky, kx).
    leak : complex array [H, W] or None
        Light that the pattern does not modulate.
    aperture : (float, float)
        Side of a pixel's active area as a share of the pitch (rows, columns); their product is the fill factor.
    modulation : (float array [2], complex array [K, N], float array [K]) or None
        Factor m on the field as it depends on the pixel's phase: the phases (rad, before `gain`) of the first and
        last sample, the factor at N phases evenly between them in each of K states, and each state's share of the
        exposure. The states' irradiances add.
    modulation_by_phase : bool
        Whether the phases of `modulation` are those on the panel, after `gain`.
    irradiance_filter : array or None
        A transfer function of irradiance over the `rfft2` frequencies of the fine grid, which acts on what the eye
        gets too.
    far_field : (complex array, complex array) or None
        The matrices (rows, columns) that take the band to the fine image grid where the image lies in the far
        field (`propagation.far_field_matrix`).
    """

    grid: Grid
    response: Array
    source: Array
    transfers: Array
    weights: Array
    gain: Array | None = None
    crosstalk: tuple[Array, Array] | None = None
    leak: Array | None = None
    aperture: tuple[Array, Array] | tuple[float, float] = (1.0, 1.0)
    irradiance_filter: Array | None = None
    far_field: tuple[Array, Array] | None = None
    modulation: Modulation | None = None
    modulation_by_phase: bool = False
    gray_levels: tuple[int, ...] = ()


def states(path: LightPath) -> Iterator[LightPath]:
    """The states of a panel during an exposure, each as a light path with one state; their irradiances add."""
    if path.modulation is None:
        yield path
        return
    ends, factors, shares = path.modulation
    for k in range(factors.shape[0]):
        one = (ends, factors[k : k + 1, ...], shares[k : k + 1])
        yield replace(path, modulation=one, weights=path.weights * shares[k])


def panel_phase(path: LightPath, gray: Array) -> Array:
    """Phase (rad) that each pixel is driven to by gray levels [..., H, W] (integers), before crosstalk."""
    xp = array_namespace(path.response)
    phase = xp.reshape(xp.take(path.response, xp.reshape(gray, (-1,)), axis=0), tuple(gray.shape))
    return phase if path.gain is None else phase * path.gain


def panel_field(path: LightPath, phase: Array) -> Array:
    """Field [..., H, W] that leaves the panel's pixels at a phase (rad), before their aperture, in its first state."""
    field = path.source * unit_phasor(phase)
    if path.modulation is not None:
        field = field * factor_at(path.modulation, phase / modulation_gain(path))
    return field if path.leak is None else field + path.leak


def modulation_gain(path: LightPath) -> Array:
    """The gain that the phases of `modulation` are before; 1 where they are those on the panel."""
    return 1 if path.gain is None or path.modulation_by_phase else path.gain


def panel_spectrum(path: LightPath, phase: Array) -> Array:
    """Spectrum of the field that leaves the panel in its first state, over the band: [..., H, W] real to complex.

    Returns
    -------
    complex array [..., n, m]
    """
    if path.crosstalk is None:
        return field_spectrum(path, panel_field(path, phase), phase)
    ky, kx = path.crosstalk
    sub = (ky.shape[0], kx.shape[0])
    down, across = (sub_pixel_offsets(path, phase, sub, axis) for axis in (0, 1))
    xp, total = array_namespace(phase), 0
    for i, mixed_rows in enumerate(mix_neighbours(phase, ky, -2)):
        fields = panel_field(path, mix_neighbours(mixed_rows, kx, -1))
        # All sub-pixels of a row at once: of small pictures, calls cost as much as numbers.
        along_rows = xp.sum(across * _row_spectrum(path.grid, fields), axis=0)
        total = total + down[i, ...] * _column_spectrum(path.grid, along_rows)
    return aperture_spectrum(path, phase, sub) / (sub[0] * sub[1]) * total


def field_spectrum(path: LightPath, field: Array, like: Array) -> Array:
    """Spectrum over the band, [..., n, m], of a field [..., H, W] that is even over each pixel; `like` is real."""
    rows = _row_spectrum(path.grid, field)
    return aperture_spectrum(path, like, (1, 1)) * _column_spectrum(path.grid, rows)


def image_field(path: LightPath, spectrum: Array, mode: int) -> Array:
    """Field of one pupil mode on the fine image grid, up to a linear phase that changes no irradiance."""
    if path.far_field is not None:
        onto_rows, onto_columns = path.far_field
        xp = array_namespace(spectrum)
        return onto_rows @ (spectrum * path.transfers[mode, ...]) @ xp.matrix_transpose(onto_columns)
    grid = path.grid
    rows, columns = image_window(grid)
    height, width = grid.image_period
    z = ifft(spectrum * path.transfers[mode, ...], axis=-1, n=width)
    z = ifft(take(z, columns, -1), axis=-2, n=height)
    return grid.fine**2 * take(z, rows, -2)


def irradiance(path: LightPath, phase: Array) -> Array:
    """Irradiance on the fine image grid for panel phase [..., H, W]: [..., *grid.image_shape]."""
    image = 0
    for state in states(path):
        image = image + mode_irradiance(state, panel_spectrum(state, phase))
    return filter_irradiance(path, image)


def mode_irradiance(path: LightPath, spectrum: Array) -> Array:
    """Sum over pupil modes of weighted |z|^2, before the irradiance filter."""
    return sum_modes(path, (image_field(path, spectrum, mode) for mode in range(path.transfers.shape[0])))


def sum_modes(path: LightPath, fields: Iterable[Array]) -> Array:
    """Sum of weighted |z|^2 over the modes' fields on the fine image grid."""
    total = None
    for mode, z in enumerate(fields):
        light = path.weights[mode] * squared_modulus(z)
        total = light if total is None else total + light
    return total


def filter_irradiance(path: LightPath, image: Array) -> Array:
    """Irradiance after the path's own irradiance filter (source extent, ghost)."""
    if path.irradiance_filter is None:
        return image
    return irfft2(rfft2(image) * path.irradiance_filter, path.grid.image_shape)


def pixel_irradiance(path: LightPath, image: Array) -> Array:
    """What pixels of the panel's pitch, centred on the panel's, integrate of fine irradiance: [..., H, W]."""
    grid = path.grid
    return at_pixels(grid, irfft2(rfft2(image) * pixel_area_spectrum(grid, image), grid.image_shape))


def pixel_area_spectrum(grid: Grid, like: Array) -> Array:
    """Transfer function of integration over a pixel's area, over the fine grid's `rfft2` frequencies."""
    fy, fx = image_frequencies(grid, like)
    return _sinc(fy * grid.pitch)[:, None] * _sinc(fx * grid.pitch)[None, :]


def aperture_spectrum(path: LightPath, like: Array, sub: tuple[int, int]) -> Array:
    """Spectrum of a pixel's active area, or of one of its `sub` sub-pixels, over the band: [n, m]."""
    fy, fx = band_frequencies(path.grid, like)
    pitch = path.grid.pitch
    rows = _sinc(fy * pitch * path.aperture[0] / sub[0])
    columns = _sinc(fx * pitch * path.aperture[1] / sub[1])
    return rows[:, None] * columns[None, :]


def sub_pixel_offsets(path: LightPath, like: Array, sub: tuple[int, int], axis: int) -> Array:
    """Linear phases over the band that put each sub-pixel at its place in the pixel, an axis.

    Returns
    -------
    complex array [sub-pixels, ..., n, 1] or [sub-pixels, ..., 1, m]
        With as many axes besides the first as `like`.
    """
    xp = array_namespace(like)
    frequency = band_frequencies(path.grid, like)[axis]
    places = (xp.arange(sub[axis], dtype=frequency.dtype, device=frequency.device) + 0.5) / sub[axis] - 0.5
    angles = -2 * math.pi * path.grid.pitch * path.aperture[axis] * places[:, None] * frequency[None, :]
    band = (-1, 1) if axis == 0 else (1, -1)
    return xp.reshape(unit_phasor(angles), (sub[axis], *[1] * (like.ndim - 2), *band))


def _row_spectrum(grid: Grid, field: Array) -> Array:
    """Spectrum along the rows alone, over the band's columns: [..., H, W] to [..., H, m]."""
    return take(fft(field, axis=-1, n=grid.padded[1]), band_window(grid)[1], -1)


def _column_spectrum(grid: Grid, spectrum: Array) -> Array:
    """Spectrum along the columns, over the band's rows: [..., H, m] to [..., n, m]."""
    return take(fft(spectrum, axis=-2, n=grid.padded[0]), band_window(grid)[0], -2)


def _sinc(x: Array) -> Array:
    xp = array_namespace(x)
    safe = math.pi * xp.where(x == 0, xp.ones_like(x), x)
    return xp.where(x == 0, xp.ones_like(x), xp.sin(safe) / safe)
