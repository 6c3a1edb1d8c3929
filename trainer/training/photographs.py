"""Photographs that scikit-image ships, as linear irradiance."""

from __future__ import annotations

import numpy as np

from runtime.solver.targets import decode_srgb


def photograph(name: str) -> np.ndarray:
    """Irradiance of a photograph's red, green and blue, float [3, h, w], 0 .. 1; a gray one has three equal planes."""
    from skimage import data

    pixels = np.asarray(getattr(data, name)())
    pixels = np.repeat(pixels[..., None], 3, -1) if pixels.ndim == 2 else pixels[..., :3]
    return np.moveaxis(decode_srgb(pixels / 255), -1, 0)
