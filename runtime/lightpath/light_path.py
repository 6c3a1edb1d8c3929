"""The light path: from phase on the panel to irradiance in the image plane, and its adjoint.

One copy, written against the array API: the headset runs it on NumPy arrays, the trainer differentiates it.
All that a bench does to the light is in the arrays of a `LightPath`, for one colour and one plane:

    phi = gain * response[gray]                     drive (and, finer than a pixel, `crosstalk`)
    u   = source * exp(j phi) + leak                panel, seen through the pixel's aperture
    z_m = IFFT(FFT(u) * transfer_m)                 pupil, one transfer function a mode
    I   = filter * sum_m weight_m |z_m|^2           irradiance, on a grid twice as fine as the panel's

The grid is twice as fine because irradiance has twice the bandwidth of the field. It is zero-padded, so
light that leaves one side does not come back on the other. Arrays are [row, column]; leading axes are
batches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import scipy.fft
from array_api_compat import array_namespace

from runtime.lightpath.fft import fft, ifft, irfft2, rfft2
from runtime.lightpath.neighbours import mix_neighbours, mix_neighbours_adjoint
from runtime.lightpath.windows import put, ring, take

Array = Any

FINE = 2  # samples of irradiance a panel pixel, an axis


@dataclass(frozen=True)
class Grid:
    """Sizes of the sampled light path.

    shape: panel (rows, columns). padded: the same with room for light to spread. margin: panel pixels kept
    around the image so that what follows (blur, shift) sees beyond its border. band: the highest frequency
    index kept, (rows, columns); index k is k / (padded * pitch) cycles/m. pitch: metres.
    """

    shape: tuple[int, int]
    padded: tuple[int, int]
    margin: int
    band: tuple[int, int]
    pitch: float

    @property
    def image_shape(self) -> tuple[int, int]:
        """Samples of the fine irradiance grid: the panel and its margin, FINE samples a pixel."""
        return (FINE * (self.shape[0] + 2 * self.margin), FINE * (self.shape[1] + 2 * self.margin))

    @property
    def band_share(self) -> float:
        """Share of the panel's band 1 / (2 pitch) that is kept, along the axis that keeps more."""
        return max(2 * edge / n for edge, n in zip(self.band, self.padded, strict=True))

    def frequency_index(self, axis: int) -> list[int]:
        """Frequency indices of the band along an axis, lowest first."""
        return list(range(-self.band[axis], self.band[axis] + 1))


MARGIN = 24  # panel pixels beyond the panel's border for which irradiance is computed


def grid_for(
    shape: tuple[int, int],
    pitch: float,
    wavelength: float,
    distance: float,
    half_width: float,
    margin: int = MARGIN,
) -> Grid:
    """The smallest grid that keeps the light path linear.

    A ray at the edge of the iris (`half_width` as a share of the panel's band 1 / (2 pitch)) walks lambda z
    half_width / (2 pitch) sideways; six tenths more hold the tails of the aperture's own diffraction. (On a 240 x 320
    panel at 30 mm the ideal model's held-out excess is 2.6e-4, 1.7e-4, 1.2e-4 and 0.9e-4 at 1.1, 1.25, 1.4 and
    1.6 times the walk. A solver alone would do with 1.1: 0.01 dB less at 540 x 960; calibration would not.)
    """
    walk = wavelength * abs(distance) * half_width / (2 * pitch**2)
    room = max(math.ceil(1.6 * walk), 2 * margin)
    rows, columns = (_even_fast_size(n + room) for n in shape)
    # One bin more than the iris, so that an edge bin always passes whole.
    band = tuple(min(math.ceil(half_width * n / 2), n - 1) for n in (rows, columns))
    return Grid(shape, (rows, columns), margin, (band[0], band[1]), pitch)


def _even_fast_size(n: int) -> int:
    size = scipy.fft.next_fast_len(n)
    while size % 2:
        size = scipy.fft.next_fast_len(size + 1)
    return size


@dataclass
class LightPath:
    """Everything a bench does to light of one colour on its way to one plane.

    response [levels]: phase (rad) of each gray level. gain [H, W] or None: factor on that phase over the
    panel. crosstalk: None, or (ky, kx), each [sub-pixels, taps]: phase of a sub-pixel as a weighted sum
    over the pixel and its neighbours. source [H, W] complex: the illuminating field. leak [H, W] complex or
    None: light the pattern does not modulate. aperture: side of a pixel's active area as a share of the
    pitch (rows, columns). transfers [M, 2 band + 1, 2 band + 1] complex and weights [M]: the pupil's modes.
    irradiance_filter: None, or a transfer function of irradiance over `rfft2` frequencies of the fine grid,
    for what the eye sees too. far_field: None, or the matrices (rows, columns) that take the band to the fine
    image grid where the image lies in the far field (`propagation.far_field_matrix`).
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


def panel_phase(path: LightPath, gray: Array) -> Array:
    """Phase (rad) that each pixel is driven to by gray levels [..., H, W] (integers), before crosstalk."""
    xp = array_namespace(path.response)
    phase = xp.reshape(xp.take(path.response, xp.reshape(gray, (-1,)), axis=0), tuple(gray.shape))
    return phase if path.gain is None else phase * path.gain


def panel_spectrum(path: LightPath, phase: Array) -> Array:
    """Spectrum of the field that leaves the panel, over the band: [..., H, W] real to [..., n, m] complex."""
    if path.crosstalk is None:
        return _aperture(path, phase, (1, 1)) * _band_spectrum(path.grid, _panel_field(path, phase))
    ky, kx = path.crosstalk
    sub = (ky.shape[0], kx.shape[0])
    total = 0
    for i in range(sub[0]):
        mixed_rows = mix_neighbours(phase, ky[i, :], -2)
        along_rows = 0
        for j in range(sub[1]):
            field = _panel_field(path, mix_neighbours(mixed_rows, kx[j, :], -1))
            along_rows = along_rows + _offset(path, phase, sub, j, 1) * _row_spectrum(path.grid, field)
        total = total + _offset(path, phase, sub, i, 0) * _column_spectrum(path.grid, along_rows)
    return _aperture(path, phase, sub) * total / (sub[0] * sub[1])


def image_field(path: LightPath, spectrum: Array, mode: int) -> Array:
    """Field of one pupil mode on the fine image grid, up to a linear phase that changes no irradiance."""
    if path.far_field is not None:
        onto_rows, onto_columns = path.far_field
        xp = array_namespace(spectrum)
        return onto_rows @ (spectrum * path.transfers[mode, ...]) @ xp.matrix_transpose(onto_columns)
    grid = path.grid
    rows, columns = _image_window(grid)
    z = ifft(spectrum * path.transfers[mode, ...], axis=-1, n=FINE * grid.padded[1])
    z = ifft(take(z, columns, -1), axis=-2, n=FINE * grid.padded[0])
    return FINE**2 * take(z, rows, -2)


def irradiance(path: LightPath, phase: Array) -> Array:
    """Irradiance on the fine image grid for panel phase [..., H, W]: [..., *grid.image_shape]."""
    return filter_irradiance(path, mode_irradiance(path, panel_spectrum(path, phase)))


def mode_irradiance(path: LightPath, spectrum: Array) -> Array:
    """Sum over pupil modes of weighted |z|^2, before the irradiance filter."""
    return _summed(path, (image_field(path, spectrum, mode) for mode in range(path.transfers.shape[0])))


def _summed(path: LightPath, fields: Iterable[Array]) -> Array:
    total = 0
    for mode, z in enumerate(fields):
        xp = array_namespace(z)
        total = total + path.weights[mode] * (xp.real(z) ** 2 + xp.imag(z) ** 2)
    return total


def filter_irradiance(path: LightPath, image: Array) -> Array:
    """Irradiance after the path's own irradiance filter (source extent, ghost)."""
    if path.irradiance_filter is None:
        return image
    return irfft2(rfft2(image) * path.irradiance_filter, path.grid.image_shape)


def phase_gradient(path: LightPath, phase: Array, irradiance_gradient: Array) -> Array:
    """Adjoint of `irradiance` at `phase`: gradient of a loss with respect to phase, [..., H, W].

    `irradiance_gradient` is the loss's gradient with respect to the fine irradiance.
    """
    return irradiance_and_pullback(path, phase)[1](irradiance_gradient)


def irradiance_and_pullback(
    path: LightPath, phase: Array, factor: bool = False
) -> tuple[Array, Callable[[Array], Array]]:
    """`irradiance`, and the map from a loss's gradient over it to the gradient over phase.

    Seed eq. 20-23, with each linear operator replaced by its adjoint: 2 z dI, back through the conjugate
    transfer, Re(-j e^{-j phi} ...). The fields of the forward pass are kept, so the way back costs no
    second one. factor: instead the gradient over a factor on the field that leaves the panel, complex [..., H, W]:
    its real part is over the factor's logarithm, its imaginary part over its phase (rad).
    """
    spectrum = panel_spectrum(path, phase)
    fields = [image_field(path, spectrum, mode) for mode in range(path.transfers.shape[0])]

    def pullback(gradient: Array) -> Array:
        xp = array_namespace(gradient)
        if path.irradiance_filter is not None:
            gradient = irfft2(rfft2(gradient) * xp.conj(path.irradiance_filter), path.grid.image_shape)
        back = 0
        for mode, z in enumerate(fields):
            back = back + _image_field_adjoint(path, 2 * path.weights[mode] * gradient * z, mode)
        return _panel_spectrum_adjoint(path, phase, back, factor)

    return filter_irradiance(path, _summed(path, fields)), pullback


def back_propagated(path: LightPath, z: Array, mode: int = 0) -> Array:
    """Field at the panel [..., H, W] that a field in the image plane [..., *grid.image_shape] comes from.

    Adjoint of the way from the panel to one pupil mode's image, which is its inverse where the pupil passes
    all.
    """
    xp = array_namespace(z)
    ramp = 1
    for axis in (0, 1):  # the linear phase that `image_field` leaves in the image
        step = 2 * math.pi * path.grid.band[axis] / (FINE * path.grid.padded[axis])
        sample = xp.arange(z.shape[axis - 2], dtype=xp.real(z).dtype) - FINE * path.grid.margin
        turn = xp.cos(step * sample) + 1j * xp.sin(step * sample)
        ramp = ramp * (turn[:, None] if axis == 0 else turn[None, :])
    spectrum = _aperture(path, xp.real(z), (1, 1)) * _image_field_adjoint(path, z * ramp, mode)
    return _band_spectrum_adjoint(path.grid, spectrum)


def pixel_irradiance(path: LightPath, image: Array) -> Array:
    """What pixels of the panel's pitch, centred on the panel's, integrate of fine irradiance: [..., H, W]."""
    grid = path.grid
    fy, fx = image_frequencies(grid, image)
    box = _sinc(fy * grid.pitch)[:, None] * _sinc(fx * grid.pitch)[None, :]
    return at_pixels(grid, irfft2(rfft2(image) * box, grid.image_shape))


def pixel_irradiance_adjoint(path: LightPath, gradient: Array) -> Array:
    """Adjoint of `pixel_irradiance`: [..., H, W] to [..., *grid.image_shape]."""
    grid = path.grid
    xp = array_namespace(gradient)
    fine = xp.zeros((*gradient.shape[:-2], *grid.image_shape), dtype=gradient.dtype)
    first = FINE * grid.margin
    rows, columns = (slice(first, first + FINE * n, FINE) for n in grid.shape)
    fine[..., rows, columns] = gradient
    fy, fx = image_frequencies(grid, gradient)
    box = _sinc(fy * grid.pitch)[:, None] * _sinc(fx * grid.pitch)[None, :]
    return irfft2(rfft2(fine) * box, grid.image_shape)


def at_pixels(grid: Grid, image: Array) -> Array:
    """Fine image at the centres of the panel's pixels: [..., *image_shape] to [..., H, W]."""
    first = FINE * grid.margin
    rows, columns = (slice(first, first + FINE * n, FINE) for n in grid.shape)
    return image[..., rows, columns]


def band_frequencies(grid: Grid, like: Array) -> tuple[Array, Array]:
    """Frequencies (cycles/m) of the band along y and x, in namespace and precision of the real `like`."""
    xp = array_namespace(like)
    fy, fx = (
        xp.asarray(grid.frequency_index(axis), dtype=like.dtype) / (grid.padded[axis] * grid.pitch)
        for axis in (0, 1)
    )
    return fy, fx


def image_frequencies(grid: Grid, like: Array) -> tuple[Array, Array]:
    """Frequencies (cycles/m) of the fine image grid's `rfft2`, along y and x."""
    xp = array_namespace(like)
    height, width = grid.image_shape
    step = grid.pitch / FINE
    fy = xp.asarray([k if k < (height + 1) // 2 else k - height for k in range(height)], dtype=like.dtype)
    fx = xp.arange(width // 2 + 1, dtype=like.dtype)
    return fy / (height * step), fx / (width * step)


def _panel_field(path: LightPath, phase: Array) -> Array:
    xp = array_namespace(phase)
    # Cosine and sine written apart cost a fraction of a complex exponential.
    field = path.source * (xp.cos(phase) + 1j * xp.sin(phase))
    return field if path.leak is None else field + path.leak


def _band_spectrum(grid: Grid, field: Array) -> Array:
    return _column_spectrum(grid, _row_spectrum(grid, field))


def _row_spectrum(grid: Grid, field: Array) -> Array:
    """Spectrum along the rows alone, over the band's columns: [..., H, W] to [..., H, m]."""
    return take(fft(field, axis=-1, n=grid.padded[1]), _band_window(grid)[1], -1)


def _column_spectrum(grid: Grid, spectrum: Array) -> Array:
    """Spectrum along the columns, over the band's rows: [..., H, m] to [..., n, m]."""
    return take(fft(spectrum, axis=-2, n=grid.padded[0]), _band_window(grid)[0], -2)


def _band_spectrum_adjoint(grid: Grid, spectrum: Array) -> Array:
    return _row_spectrum_adjoint(grid, _column_spectrum_adjoint(grid, spectrum))


def _row_spectrum_adjoint(grid: Grid, spectrum: Array) -> Array:
    padded = grid.padded[1]
    return padded * ifft(put(spectrum, _band_window(grid)[1], -1, padded), axis=-1)[..., :, : grid.shape[1]]


def _column_spectrum_adjoint(grid: Grid, spectrum: Array) -> Array:
    padded = grid.padded[0]
    return padded * ifft(put(spectrum, _band_window(grid)[0], -2, padded), axis=-2)[..., : grid.shape[0], :]


def _image_field_adjoint(path: LightPath, z: Array, mode: int) -> Array:
    xp = array_namespace(z)
    if path.far_field is not None:
        onto_rows, onto_columns = path.far_field
        back = xp.conj(xp.matrix_transpose(onto_rows)) @ z @ xp.conj(onto_columns)
        return xp.conj(path.transfers[mode, ...]) * back
    grid = path.grid
    rows, columns = _image_window(grid)
    height, width = (FINE * n for n in grid.padded)
    spectrum = fft(put(z, rows, -2, height), axis=-2)[..., : 2 * grid.band[0] + 1, :]
    spectrum = fft(put(spectrum, columns, -1, width), axis=-1)[..., :, : 2 * grid.band[1] + 1]
    return xp.conj(path.transfers[mode, ...]) * spectrum * (FINE**2 / (height * width))


def _panel_spectrum_adjoint(path: LightPath, phase: Array, spectrum: Array, factor: bool = False) -> Array:
    """Adjoint of `panel_spectrum` over phase, or over a factor on the field that leaves the panel."""
    xp = array_namespace(phase)

    def here(field_gradient: Array, driven: Array) -> Array:
        if factor:
            return xp.conj(_panel_field(path, driven)) * field_gradient
        turned = xp.conj(path.source) * field_gradient
        return xp.cos(driven) * xp.imag(turned) - xp.sin(driven) * xp.real(turned)

    if path.crosstalk is None:
        return here(_band_spectrum_adjoint(path.grid, _aperture(path, phase, (1, 1)) * spectrum), phase)
    ky, kx = path.crosstalk
    sub = (ky.shape[0], kx.shape[0])
    spectrum = _aperture(path, phase, sub) * spectrum / (sub[0] * sub[1])
    total = 0
    for i in range(sub[0]):
        mixed_rows = mix_neighbours(phase, ky[i, :], -2)
        row_gradient = 0
        rows_back = _column_spectrum_adjoint(path.grid, xp.conj(_offset(path, phase, sub, i, 0)) * spectrum)
        for j in range(sub[1]):
            driven = mix_neighbours(mixed_rows, kx[j, :], -1)
            back = _row_spectrum_adjoint(path.grid, xp.conj(_offset(path, phase, sub, j, 1)) * rows_back)
            own = here(back, driven)
            row_gradient = row_gradient + (own if factor else mix_neighbours_adjoint(own, kx[j, :], -1))
        total = total + (row_gradient if factor else mix_neighbours_adjoint(row_gradient, ky[i, :], -2))
    return total


def _aperture(path: LightPath, like: Array, sub: tuple[int, int]) -> Array:
    """Spectrum of a pixel's active area, or of one of its sub-pixels, over the band."""
    fy, fx = band_frequencies(path.grid, like)
    pitch = path.grid.pitch
    rows = _sinc(fy * pitch * path.aperture[0] / sub[0])
    columns = _sinc(fx * pitch * path.aperture[1] / sub[1])
    return rows[:, None] * columns[None, :]


def _offset(path: LightPath, like: Array, sub: tuple[int, int], index: int, axis: int) -> Array:
    """Linear phase over the band that puts a sub-pixel where it is within the pixel's active area, an axis:
    [n, 1] or [1, m].
    """
    xp = array_namespace(like)
    frequency = band_frequencies(path.grid, like)[axis]
    place = path.grid.pitch * path.aperture[axis] * ((index + 0.5) / sub[axis] - 0.5)
    angle = -2 * math.pi * place * (frequency[:, None] if axis == 0 else frequency[None, :])
    return xp.cos(angle) + 1j * xp.sin(angle)


def _sinc(x: Array) -> Array:
    xp = array_namespace(x)
    safe = math.pi * xp.where(x == 0, xp.ones_like(x), x)
    return xp.where(x == 0, xp.ones_like(x), xp.sin(safe) / safe)


def _band_window(grid: Grid) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    return ring(-grid.band[0], 2 * grid.band[0] + 1, grid.padded[0]), ring(
        -grid.band[1], 2 * grid.band[1] + 1, grid.padded[1]
    )


def _image_window(grid: Grid) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    first = -FINE * grid.margin
    height, width = grid.image_shape
    return ring(first, height, FINE * grid.padded[0]), ring(first, width, FINE * grid.padded[1])
