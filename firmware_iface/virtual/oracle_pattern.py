"""The best pattern for a bench whose defects are known exactly (an oracle): for tests and demonstrations only.

Adam on gray levels through the sub-pixel simulation; the loss is 1 less the squared correlation of amplitude,
which is the amplitude error with its best scale, free of the total light.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_optics import BenchOptics
from firmware_iface.virtual.simulated_sensor import Integrator

Array = NDArray[np.float64]


def amplitude_loss(irradiance: NDArray[np.floating], target: Array) -> tuple[float, Array]:
    """1 - (sum sqrt(I) a)^2 / (sum I sum a^2) with a = sqrt(target), and its gradient over I, [H, W]."""
    a = np.sqrt(target)
    light = np.clip(irradiance, 0, None).astype(np.float64) + 1e-9
    root = np.sqrt(light)
    c, energy, norm = float((root * a).sum()), float(light.sum()), float((a * a).sum())
    # sqrt's slope is bounded where there is no light
    slope = a / np.maximum(root, 0.02 * np.sqrt(energy / light.size))
    return 1 - c * c / (energy * norm), c / (energy * norm) * (c / energy - slope)


def ideal_start(optics: BenchOptics, target: Array, channel: str, plane_mm: float, seed: int) -> Array:
    """Gray levels [H, W] that the target's amplitude with a smooth random phase asks for at the panel."""
    path, drive = optics.path(channel, plane_mm), optics.drive(channel)
    band = path.band
    h, w = target.shape
    rng = np.random.default_rng([seed, 5])
    phase = smooth_noise(rng, h, w, 16.0) * 2.5
    field = np.zeros(band.samples, np.complex64)
    s = band.oversampling
    image = np.sqrt(target) * np.exp(1j * phase)
    field[: s * h, : s * w] = np.repeat(np.repeat(image, s, 0), s, 1)
    middle = path.lines[len(path.lines) // 2]
    back = band.spectrum_adjoint(band.field_adjoint(field) * middle.transfer.conj())
    lit = optics.surface(middle.wavelength_nm).lit
    q = drive.q
    asked = np.angle((back * lit.conj()).reshape(h, q, w, q).sum((1, 3)))
    return drive.gray_of(np.mod(drive.sign * asked, 2 * np.pi))


def smooth_noise(rng: np.random.Generator, height: int, width: int, radius_px: float) -> Array:
    """Gaussian noise of unit variance, blurred over `radius_px`, [height, width]."""
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :]
    blur = np.exp(-2 * (np.pi * radius_px) ** 2 * (fy**2 + fx**2))
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((height, width))) * blur, s=(height, width))
    return np.asarray(noise / noise.std())


def descend(
    optics: BenchOptics,
    integrator: Integrator,
    target: Array,
    channel: str,
    plane_mm: float,
    iterations: int,
    start: Array | None = None,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> NDArray[np.uint8]:
    """Gray levels [H, W] whose irradiance on panel pixels is nearest to `target` in amplitude, up to scale.

    Parameters
    ----------
    optics : BenchOptics
    integrator : Integrator
    target : float64 array [H, W]
        Target irradiance, any unit.
    channel : str
    plane_mm : float, mm
    iterations : int
    start : float64 array [H, W], or None
        Gray levels that small steps improve; None: a smooth random phase at the image, and large steps.
    seed : int
        Of that random phase.
    progress : callable or None
        Called with the iteration and the loss.

    Returns
    -------
    uint8 array [H, W]
    """
    drive = optics.drive(channel)
    gray = ideal_start(optics, target, channel, plane_mm, seed) if start is None else start.astype(np.float64)
    mean, square = np.zeros_like(gray), np.zeros_like(gray)
    # The first step; it falls to a tenth along a half cosine.
    step_rad = 0.4 if start is None else 0.03
    step_gray = step_rad * drive.levels / (2 * np.pi)
    for i in range(iterations):
        samples, pullback = optics.irradiance_and_pullback(gray, channel, plane_mm)
        loss, gradient = amplitude_loss(integrator.display(samples), target)
        g = pullback(integrator.display_adjoint(gradient))
        mean = 0.9 * mean + 0.1 * g
        square = 0.99 * square + 0.01 * g * g
        rate = step_gray * (0.1 + 0.45 * (1 + np.cos(np.pi * i / max(1, iterations))))
        unbiased = np.sqrt(square / (1 - 0.99 ** (i + 1)))
        unbiased += 0.05 * np.sqrt(np.mean(unbiased**2)) + 1e-30
        gray = drive.wrapped(gray - rate * mean / (1 - 0.9 ** (i + 1)) / unbiased)
        if progress:
            progress(i, loss)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)
