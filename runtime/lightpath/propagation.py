"""Free-space propagation between the panel and an image plane: transfer functions, and where they hold.

Three forms of the diffraction integral (Chakravarthula et al. 2020, sections 1.1-1.2): the band-limited angular
spectrum (exact; Matsushima and Shimobaba 2009), Fresnel (paraxial) and Fraunhofer (far field). Written against the
array API: NumPy in the headset, any differentiable namespace in the trainer. Lengths are in metres, frequencies in
cycles per metre; frequency grids are the DFT's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from array_api_compat import array_namespace

from firmware_iface.errors import InputError

Array = Any

METHODS = ("angular_spectrum", "fresnel", "fraunhofer")


@dataclass(frozen=True)
class Aperture:
    """The sampled area that a propagation starts from.

    Attributes
    ----------
    shape : (int, int)
        Samples: rows, columns.
    padded : (int, int)
        The same with zero padding.
    pitch : float, m
        Between samples.
    """

    shape: tuple[int, int]
    padded: tuple[int, int]
    pitch: float

    @property
    def extent(self) -> float:
        """Larger side of the lit area, metres."""
        return max(self.shape) * self.pitch


def transfer_function(
    fy: Array, fx: Array, wavelength: Array, distance: Array, limits: tuple[float, float], method: str
) -> Array:
    """Complex transfer function of free space over a grid of spatial frequencies.

    It lacks the plane wave's own 2 pi z / lambda, which is thousands of turns and changes no irradiance.
    Evanescent frequencies are zero.

    Parameters
    ----------
    fy : float array [n, 1], cycles/m
    fx : float array [1, m], cycles/m
    wavelength, distance : float or scalar array, m
    limits : (float, float), cycles/m
        Along y and x: beyond them the sampled function is aliased and set to zero (see `band_limit`).
    method : str
        "angular_spectrum", or "fresnel" for its paraxial expansion.

    Returns
    -------
    complex array [n, m]

    Raises
    ------
    InputError
        For another method.

    References
    ----------
    Chakravarthula et al. 2020, eq. 5 (angular spectrum) and eq. 8 (Fresnel).
    """
    xp = array_namespace(fy, fx)
    sine2 = (wavelength * fy) ** 2 + (wavelength * fx) ** 2
    passed = (sine2 < 1) & (xp.abs(fy) <= limits[0]) & (xp.abs(fx) <= limits[1])
    if method == "angular_spectrum":
        # sqrt(1 - s) - 1 written so that single precision keeps all of its digits for small s.
        sine2 = xp.where(passed, sine2, xp.zeros_like(sine2))
        cosine_less_one = -sine2 / (1 + xp.sqrt(1 - sine2))
    elif method == "fresnel":
        cosine_less_one = -sine2 / 2
    else:
        raise InputError(
            f"propagation method '{method}' has no transfer function: use {' or '.join(METHODS[:2])}"
        )
    angle = (2 * math.pi) * (distance / wavelength) * cosine_less_one
    inside = xp.where(passed, xp.ones_like(angle), xp.zeros_like(angle))
    return inside * xp.cos(angle) + 1j * (inside * xp.sin(angle))


def band_limit(wavelength: float, distance: float, side: float) -> float:
    """Highest frequency that a sampled transfer function carries.

    Parameters
    ----------
    wavelength, distance : float, m
    side : float, m
        Of the field; frequency samples are 1/side apart.

    Returns
    -------
    float, cycles/m

    References
    ----------
    Matsushima and Shimobaba 2009, eq. 13.
    """
    return 1 / (wavelength * math.sqrt((2 * distance / side) ** 2 + 1))


def far_field(u: Array, pitch: float, y: Array, x: Array, wavelength: Array, distance: Array) -> Array:
    """Fraunhofer field, up to the quadratic phase in the image plane, which changes no irradiance.

    A matrix Fourier transform, so the image grid is free.

    Parameters
    ----------
    u : complex array [..., H, W]
        The field in the aperture, samples `pitch` apart.
    pitch : float, m
    y, x : float array [n], float array [m], m
        Positions in the image plane, from the axis.
    wavelength, distance : float or scalar array, m

    Returns
    -------
    complex array [..., n, m]

    References
    ----------
    Goodman, Introduction to Fourier Optics, eq. 4-25.
    """
    xp = array_namespace(u)
    height, width = u.shape[-2:]
    rows = _far_kernel(y, height, pitch, wavelength, distance)
    columns = _far_kernel(x, width, pitch, wavelength, distance)
    return rows @ u @ xp.matrix_transpose(columns)


def far_field_matrix(
    band: list[int],
    padded: int,
    count: int,
    pitch: float,
    position: Array,
    wavelength: Array,
    distance: Array,
) -> Array:
    """Matrix from the spectrum along one axis to the Fraunhofer field.

    An inverse DFT onto the panel, then `far_field` along this axis.

    Parameters
    ----------
    band : list of int
        Frequency indices of the spectrum.
    padded : int
        Samples of the DFT that the spectrum is taken from.
    count : int
        Samples of it, from the first, that the field is on.
    pitch : float, m
    position : float array [n], m
        In the image plane, from the axis.
    wavelength, distance : float or scalar array, m

    Returns
    -------
    complex array [n, len(band)]
    """
    xp = array_namespace(position)
    kind = {"dtype": position.dtype, "device": position.device}
    sample = xp.arange(count, **kind)
    angle = (2 * math.pi / padded) * sample[:, None] * xp.asarray(band, **kind)[None, :]
    inverse = (xp.cos(angle) + 1j * xp.sin(angle)) / padded
    return _far_kernel(position, count, pitch, wavelength, distance) @ inverse


def _far_kernel(position: Array, count: int, pitch: float, wavelength: Array, distance: Array) -> Array:
    xp = array_namespace(position)
    sample = xp.arange(count, dtype=position.dtype, device=position.device)
    samples = (sample - (count - 1) / 2) * pitch
    angle = -2 * math.pi / (wavelength * distance) * position[:, None] * samples[None, :]
    return (pitch / (wavelength * distance) ** 0.5) * (xp.cos(angle) + 1j * xp.sin(angle))


def check_sampling(
    method: str, aperture: Aperture, wavelength: float, distance: float, half_band: float
) -> None:
    """Refuse a propagation that the grid cannot sample.

    Parameters
    ----------
    method : str
        One of METHODS.
    aperture : Aperture
    wavelength, distance : float, m
    half_band : float, cycles/m
        The highest frequency that the iris passes.

    Raises
    ------
    InputError
        Where `method` cannot be sampled: which limit, by how much, and what would hold.
    """
    if method not in METHODS:
        raise InputError(f"unknown propagation method '{method}': use one of {', '.join(METHODS)}")
    if not (math.isfinite(wavelength) and wavelength > 0 and math.isfinite(distance) and distance != 0):
        raise InputError(
            f"propagation needs a positive wavelength and a distance that is not zero, not {wavelength:g} m "
            f"and {distance:g} m"
        )
    z = abs(distance)
    if method == "fraunhofer":
        least = 2 * aperture.extent**2 / wavelength
        if z < least:
            raise InputError(
                f"Fraunhofer propagation holds beyond 2 D^2 / lambda = {least:.3g} m for a panel "
                f"{aperture.extent * 1e3:.3g} mm wide; the image plane is at {z:.3g} m: use angular_spectrum"
            )
        return
    if wavelength * half_band >= 1:
        raise InputError(
            f"the iris passes {half_band * 1e-3:.4g} cycles/mm, beyond 1/lambda = {1e-3 / wavelength:.4g}: "
            "use a coarser pitch or a smaller iris"
        )
    if method == "fresnel":
        # The first term that the paraxial expansion drops must stay small for the steepest ray.
        error = 2 * math.pi * z / wavelength * (2 * (wavelength * half_band) ** 2) ** 2 / 8
        if error > 0.5:
            farthest = z * 0.5 / error
            raise InputError(
                f"Fresnel propagation errs by {error:.3g} rad at the edge of the band (0.5 is the most that "
                f"holds): use angular_spectrum, or a distance below {farthest * 1e3:.3g} mm"
            )
    limit = min(band_limit(wavelength, z, n * aperture.pitch) for n in aperture.padded)
    if limit < 0.5 * half_band:
        farthest = min(aperture.padded) * aperture.pitch / (wavelength * half_band)
        raise InputError(
            f"at {z * 1e3:.4g} mm the sampled transfer function carries {limit * 1e-3:.4g} cycles/mm of the "
            f"{half_band * 1e-3:.4g} that the iris passes: use at most {farthest * 1e3:.3g} mm, "
            "or a larger panel"
        )
