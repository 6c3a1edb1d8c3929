"""The adjoint of the light path: from a loss's gradient over irradiance to the one over phase on the panel.

Every linear operator of `runtime.lightpath.light_path` is replaced by its adjoint (Chakravarthula et al. 2020,
eq. 20-23). Written against the array API, without automatic differentiation: the headset has none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from array_api_compat import array_namespace

from runtime.lightpath.crosstalk import mix_neighbours, mix_neighbours_adjoint
from runtime.lightpath.fft import fft, ifft, irfft2, rfft2
from runtime.lightpath.grid import Grid, band_window, image_window, pixel_slices
from runtime.lightpath.light_path import (
    LightPath,
    aperture_spectrum,
    filter_irradiance,
    image_field,
    modulation_gain,
    panel_field,
    panel_spectrum,
    pixel_area_spectrum,
    states,
    sub_pixel_offsets,
    sum_modes,
)
from runtime.lightpath.modulation import factor_at, slope_at
from runtime.lightpath.periodic_axis import put

Array = Any


def irradiance_and_pullback(
    path: LightPath, phase: Array, factor: bool = False
) -> tuple[Array, Callable[[Array], Array]]:
    """`irradiance`, and the function from a loss's gradient over it to the gradient over phase.

    The steps back are 2 z dI, the conjugate transfer, Re(-j e^{-j phi} ...). The fields of the forward pass are
    kept, so the way back costs no second one.

    Parameters
    ----------
    path : LightPath
    phase : float array [..., H, W], rad
    factor : bool
        Instead of the gradient over phase, give the one over a factor on the field that leaves the panel, complex
        [..., H, W]: its real part is over the factor's logarithm, its imaginary part over its phase (rad).

    Returns
    -------
    irradiance : float array [..., *grid.image_shape]
    pullback : callable
        Takes a gradient of that shape and returns [..., H, W].

    References
    ----------
    Chakravarthula et al. 2020, eq. 20-23.
    """
    image, kept = 0, []
    for state in states(path):
        spectrum = panel_spectrum(state, phase)
        fields = [image_field(state, spectrum, mode) for mode in range(path.transfers.shape[0])]
        image = image + sum_modes(state, fields)
        kept.append((state, fields))

    def pullback(gradient: Array) -> Array:
        xp = array_namespace(gradient)
        if path.irradiance_filter is not None:
            gradient = irfft2(rfft2(gradient) * xp.conj(path.irradiance_filter), path.grid.image_shape)
        total = 0
        for state, fields in kept:
            back = _over_modes(state, fields, gradient)
            total = total + _panel_spectrum_adjoint(state, phase, back, factor)
        return total

    return filter_irradiance(path, image), pullback


def irradiance_and_field_pullback(path: LightPath, phase: Array) -> tuple[Array, Callable[[Array], Array]]:
    """`mode_irradiance` of a phase, and the function from a loss's gradient over it to the one over the panel's field.

    Parameters
    ----------
    path : LightPath
        Without crosstalk; of a modulation, the first state counts.
    phase : float array [..., H, W], rad

    Returns
    -------
    irradiance : float array [..., *grid.image_shape]
        Before the path's irradiance filter.
    pullback : callable
        Takes a gradient of that shape and returns G, complex [..., H, W]: a change d of the field that leaves the
        panel changes the loss by Re(conj(G) d).
    """
    spectrum = panel_spectrum(path, phase)
    fields = [image_field(path, spectrum, mode) for mode in range(path.transfers.shape[0])]

    def pullback(gradient: Array) -> Array:
        back = _over_modes(path, fields, gradient)
        return _field_adjoint(path, aperture_spectrum(path, phase, (1, 1)) * back)

    return sum_modes(path, fields), pullback


def pixel_irradiance_adjoint(path: LightPath, gradient: Array) -> Array:
    """Adjoint of `pixel_irradiance`: [..., H, W] to [..., *grid.image_shape]."""
    grid = path.grid
    xp = array_namespace(gradient)
    shape = (*gradient.shape[:-2], *grid.image_shape)
    fine = xp.zeros(shape, dtype=gradient.dtype, device=gradient.device)
    rows, columns = pixel_slices(grid)
    fine[..., rows, columns] = gradient
    return irfft2(rfft2(fine) * pixel_area_spectrum(grid, gradient), grid.image_shape)


def _over_modes(path: LightPath, fields: list[Array], gradient: Array) -> Array:
    """Gradient over the panel's spectrum from the one over irradiance before filters."""
    back = 0
    for mode, z in enumerate(fields):
        back = back + _image_field_adjoint(path, 2 * path.weights[mode] * gradient * z, mode)
    return back


def _field_adjoint(path: LightPath, spectrum: Array) -> Array:
    return _row_spectrum_adjoint(path.grid, _column_spectrum_adjoint(path.grid, spectrum))


def _image_field_adjoint(path: LightPath, z: Array, mode: int) -> Array:
    xp = array_namespace(z)
    if path.far_field is not None:
        onto_rows, onto_columns = path.far_field
        back = xp.conj(xp.matrix_transpose(onto_rows)) @ z @ xp.conj(onto_columns)
        return xp.conj(path.transfers[mode, ...]) * back
    grid = path.grid
    rows, columns = image_window(grid)
    height, width = grid.image_period
    spectrum = fft(put(z, rows, -2, height), axis=-2)[..., : 2 * grid.band[0] + 1, :]
    spectrum = fft(put(spectrum, columns, -1, width), axis=-1)[..., :, : 2 * grid.band[1] + 1]
    return xp.conj(path.transfers[mode, ...]) * spectrum * (grid.fine**2 / (height * width))


def _panel_spectrum_adjoint(path: LightPath, phase: Array, spectrum: Array, factor: bool = False) -> Array:
    """Adjoint of `panel_spectrum` over phase, or over a factor on the field that leaves the panel."""
    xp = array_namespace(phase)

    def here(field_gradient: Array, driven: Array) -> Array:
        if factor:
            return xp.conj(panel_field(path, driven)) * field_gradient
        turned = xp.conj(path.source) * field_gradient
        if path.modulation is not None:
            # The derivative of m(phi) exp(j phi) is (m' + j m) exp(j phi).
            gain = modulation_gain(path)
            at = driven / gain
            slope = slope_at(path.modulation, at) / gain
            turned = xp.conj(factor_at(path.modulation, at) - 1j * slope) * turned
        return xp.cos(driven) * xp.imag(turned) - xp.sin(driven) * xp.real(turned)

    if path.crosstalk is None:
        return here(_field_adjoint(path, aperture_spectrum(path, phase, (1, 1)) * spectrum), phase)
    ky, kx = path.crosstalk
    sub = (ky.shape[0], kx.shape[0])
    spectrum = aperture_spectrum(path, phase, sub) * spectrum / (sub[0] * sub[1])
    down, across = (sub_pixel_offsets(path, phase, sub, axis) for axis in (0, 1))
    total = 0
    for i, mixed_rows in enumerate(mix_neighbours(phase, ky, -2)):
        row_gradient = 0
        rows_back = _column_spectrum_adjoint(path.grid, xp.conj(down[i]) * spectrum)
        for j, driven in enumerate(mix_neighbours(mixed_rows, kx, -1)):
            own = here(_row_spectrum_adjoint(path.grid, xp.conj(across[j]) * rows_back), driven)
            row_gradient = row_gradient + (own if factor else mix_neighbours_adjoint(own, kx[j, :], -1))
        total = total + (row_gradient if factor else mix_neighbours_adjoint(row_gradient, ky[i, :], -2))
    return total


def _row_spectrum_adjoint(grid: Grid, spectrum: Array) -> Array:
    padded = grid.padded[1]
    return padded * ifft(put(spectrum, band_window(grid)[1], -1, padded), axis=-1)[..., :, : grid.shape[1]]


def _column_spectrum_adjoint(grid: Grid, spectrum: Array) -> Array:
    padded = grid.padded[0]
    return padded * ifft(put(spectrum, band_window(grid)[0], -2, padded), axis=-2)[..., : grid.shape[0], :]
