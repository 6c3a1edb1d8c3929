"""The light path of a perfect bench: a full turn of phase, a uniform beam, a square iris, free space."""

from __future__ import annotations

import math

import numpy as np

from runtime.lightpath.grid import band_frequencies, beyond_edge, grid_for, passed_share
from runtime.lightpath.light_path import LightPath
from runtime.lightpath.propagation import Aperture, band_limit, check_sampling, transfer_function


def ideal_path(
    shape: tuple[int, int], pitch: float, wavelength: float, distance: float, half_width: float
) -> LightPath:
    """A perfect panel of 256 levels, in double precision.

    Parameters
    ----------
    shape : (int, int), pixels
    pitch, wavelength, distance : float, m
    half_width : float
        Of the iris, as a share of the panel's band.

    Returns
    -------
    LightPath

    Raises
    ------
    InputError
        Where the sampling does not hold.
    """
    grid = grid_for(shape, pitch, wavelength, distance, half_width)
    band = 1 / (2 * pitch)
    aperture = Aperture(shape, grid.padded, pitch)
    check_sampling("angular_spectrum", aperture, wavelength, distance, half_width * band * (1 + 1e-9))
    fy, fx = band_frequencies(grid, np.zeros((), np.float64))
    rows, columns = (
        passed_share(f, (half_width + beyond_edge(count)) * band, 1 / (padded * pitch))
        for f, count, padded in zip((fy, fx), shape, grid.padded, strict=True)
    )
    limits = tuple(band_limit(wavelength, distance, n * pitch) for n in grid.padded)
    transfer = transfer_function(
        fy[:, None], fx[None, :], wavelength, distance, (limits[0], limits[1]), "angular_spectrum"
    )
    return LightPath(
        grid=grid,
        response=2 * math.pi * np.arange(256) / 256,
        source=np.ones(shape, np.complex128),
        transfers=(rows[:, None] * columns[None, :] * transfer)[None],
        weights=np.ones(1),
    )


def single(path: LightPath) -> LightPath:
    """An ideal path in single precision, as a bundle holds them."""
    return LightPath(
        path.grid,
        path.response.astype(np.float32),
        path.source.astype(np.complex64),
        path.transfers.astype(np.complex64),
        path.weights.astype(np.float32),
    )
