"""Light paths for tests, random or in closed form, that need neither a bench file nor the trainer."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from runtime.lightpath import ideal_path as ideal
from runtime.lightpath.light_path import LightPath

PITCH, WAVELENGTH = 8e-6, 520e-9
ARRAYS = (
    "response",
    "source",
    "transfers",
    "weights",
    "gain",
    "crosstalk",
    "leak",
    "aperture",
    "irradiance_filter",
    "modulation",
)


def ideal_path(
    shape: tuple[int, int] = (48, 64),
    distance: float = 0.012,
    half_width: float = 1.0,
    dtype: type = np.float64,
) -> LightPath:
    """A perfect panel of 256 levels under a uniform beam, with a square iris, by the angular spectrum."""
    path = ideal.ideal_path(shape, PITCH, WAVELENGTH, distance, half_width)
    return converted(path, dtype)


def random_path(
    shape: tuple[int, int] = (24, 30), half_width: float = 0.8, dtype: type = np.float64, **without: None
) -> LightPath:
    """All that a path may have at once, with three modes and two states, without what `without` names."""
    rng = np.random.default_rng(3)
    # Drawn first: whatever the grid, the panel's phases then lie as far from the kinks of the modulation's curves.
    crosstalk = (_taps(rng, 3, 5), _taps(rng, 2, 3))
    path = ideal_path(shape, 0.005, half_width)
    grid = path.grid

    def noise(*size: int) -> np.ndarray:
        return rng.normal(size=size) + 1j * rng.normal(size=size)

    full = replace(
        path,
        gain=1 + 0.1 * rng.normal(size=shape),
        source=path.source + 0.3 * noise(*shape),
        leak=0.2 * noise(*shape),
        transfers=path.transfers * (1 + 0.3 * noise(3, *path.transfers.shape[1:])),
        weights=np.array([0.5, 0.3, 0.2]),
        crosstalk=crosstalk,
        aperture=(0.9, 0.8),
        irradiance_filter=np.fft.rfft2(rng.normal(size=grid.image_shape) / grid.image_shape[0]),
        modulation=_modulation(),
    )
    return converted(replace(full, **without), dtype)


def _modulation() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two smooth states over phases that the tests' own reach: absorption, and a swing of the phase."""
    at = np.linspace(-40, 40, 4001)
    factors = np.stack([1 - 0.3 * np.sin(at / 3) ** 2, (0.8 + 0.1 * np.cos(at)) * np.exp(0.1j * at)])
    return np.array([-40.0, 40.0]), factors.astype(complex), np.array([0.7, 0.3])


def _taps(rng: np.random.Generator, sub: int, taps: int) -> np.ndarray:
    weights = rng.random((sub, taps))
    return weights / weights.sum(1, keepdims=True)


def converted(path: LightPath, dtype: type) -> LightPath:
    """The same path in another precision."""
    pair = {np.float64: np.complex128, np.float32: np.complex64}[dtype]

    def one(value: Any) -> Any:
        if value is None:
            return None
        if isinstance(value, tuple):
            return tuple(one(part) for part in value)
        return np.asarray(value).astype(pair if np.iscomplexobj(value) else dtype)

    return replace(path, **{name: one(getattr(path, name)) for name in ARRAYS})


def torch_path(path: LightPath) -> LightPath:
    """The same path on torch tensors."""
    import torch

    def one(value: Any) -> Any:
        if value is None:
            return None
        return tuple(one(part) for part in value) if isinstance(value, tuple) else torch.as_tensor(value)

    return replace(path, **{name: one(getattr(path, name)) for name in ARRAYS})


def padded_irradiance(
    phase: np.ndarray, distance: float, oversampling: int = 4, pad: int = 3, iris: float = 1.0
) -> np.ndarray:
    """What panel-sized pixels integrate, [H, W], of square pixels of this phase: an independent simulation.

    Plain double-precision FFTs of the panel drawn on sub-pixels, each a square, `pad` times larger all round;
    the exact transfer function of free space; the panel's own band passes, or the `iris` share of it.
    """
    height, width = phase.shape
    q = oversampling
    field = np.zeros((pad * height * q, pad * width * q), complex)
    field[: height * q, : width * q] = np.kron(np.exp(1j * phase), np.ones((q, q)))
    fy = np.fft.fftfreq(field.shape[0], PITCH / q)[:, None]
    fx = np.fft.fftfreq(field.shape[1], PITCH / q)[None, :]
    square = np.sinc(fy * PITCH / q) * np.sinc(fx * PITCH / q)
    edge = iris / (2 * PITCH) * (1 + 1e-9)
    passed = (np.abs(fy) <= edge) & (np.abs(fx) <= edge)
    root = np.sqrt(np.maximum(1 / WAVELENGTH**2 - fy**2 - fx**2, 0))
    image = np.fft.ifft2(np.fft.fft2(field) * square * passed * np.exp(2j * np.pi * distance * root))
    light = np.fft.ifft2(np.fft.fft2(np.abs(image) ** 2) * square).real[: height * q, : width * q]
    return light.reshape(height, q, width, q).mean((1, 3))


def scene(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    """A picture with edges, a gradient, texture and darkness: irradiance [H, W], 0 .. 1."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.linspace(-1, 1, shape[0]), np.linspace(-1, 1, shape[1]), indexing="ij")
    picture = 0.35 + 0.25 * x
    picture[(y + 0.2) ** 2 + (x - 0.3) ** 2 < 0.12] = 0.9
    picture[np.abs(y - 0.45) < 0.12] = 0.04
    picture += 0.1 * np.sin(14 * x + 9 * y) * (x < -0.2)
    for _ in range(6):
        i, j = rng.integers(2, shape[0] - 6), rng.integers(2, shape[1] - 6)
        picture[i : i + 4, j : j + 4] = rng.random()
    return np.clip(picture, 0.02, 1).astype(np.float32)


def one_mode(path: LightPath) -> LightPath:
    """The path with the first of its pupil's modes alone."""
    return replace(path, transfers=path.transfers[:1], weights=path.weights[:1])


# What a light path may have, alone and together.
PATHS = {
    "everything": random_path(),
    "iris twice the band": random_path((20, 26), 1.95),
    "iris half the band": random_path((21, 25), 0.5),
    "no crosstalk": random_path(crosstalk=None),
    "no crosstalk, wide": random_path((20, 26), 1.9, crosstalk=None),
    "no leak, no filter": random_path(leak=None, irradiance_filter=None),
    "phase alone": random_path(modulation=None),
    "by the panel's phase": replace(random_path(), modulation_by_phase=True),
    "two states, one mode": one_mode(random_path(crosstalk=None, irradiance_filter=None)),
    "ideal": ideal_path((24, 30), 0.005),
}
