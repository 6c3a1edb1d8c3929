"""The simulated bench's light over its whole padded window, for tests of energy and of where light goes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual import BenchDescription
from firmware_iface.virtual.bench_optics import BenchOptics

Array = NDArray[np.float64]


def samples(
    bench: BenchDescription, gray: NDArray[np.uint8], plane_mm: float
) -> tuple[Array, Array, Array, int]:
    """Irradiance samples, their (y, x) in panel pixels from the panel's centre, and how many are in a pixel."""
    optics = BenchOptics(bench)
    light = optics.irradiance(gray, "green", plane_mm).astype(float)
    band = optics.path("green", plane_mm).band
    grids = []
    for n, whole in zip(gray.shape, band.padded, strict=True):
        at = np.arange(band.oversampling * whole) / band.oversampling
        at = np.where(at > n + (whole - n) / 2, at - whole, at)  # the window wraps round
        grids.append(at - (n - 1) / 2)
    return light, grids[0][:, None], grids[1][None, :], band.oversampling**2
