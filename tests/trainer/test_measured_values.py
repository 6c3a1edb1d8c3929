"""What effects read off the captures: a fixed pattern of pixels, and not what their neighbours tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from trainer.effects.measured_values import pixel_pattern

SHAPE = (96, 120)


@dataclass
class Pictures:
    signal: torch.Tensor
    noise: torch.Tensor
    mask: torch.Tensor


@dataclass
class Seen:
    batch: Pictures
    prediction: torch.Tensor


def seen(gain: np.ndarray, offset: np.ndarray, pictures: int = 12, noise: float = 1.0) -> Any:
    """Pictures of random light by a camera whose pixels have these gains and offsets."""
    draw = np.random.default_rng(8)
    light = draw.gamma(1.5, 200.0, (pictures, *SHAPE))
    signal = (1 + gain) * light + offset + draw.normal(0, noise, light.shape)
    as_tensor = [torch.tensor(a) for a in (signal, np.full(light.shape, noise**2), np.ones(light.shape))]
    return Seen(Pictures(*as_tensor), torch.tensor(light))


def test_a_fixed_pattern_is_recovered_pixel_by_pixel() -> None:
    draw = np.random.default_rng(1)
    gain, offset = draw.normal(0, 0.03, SHAPE), draw.normal(0, 8.0, SHAPE)
    found = pixel_pattern([seen(gain, offset)])
    assert np.std(found["gain"] - gain) < 0.15 * 0.03
    assert np.std(found["offset"] - offset) < 0.3 * 8.0
    assert abs(found["gain_rms"] / 3.0 - 1) < 0.1
    assert abs(found["offset_rms"] / 8.0 - 1) < 0.15


def test_fringes_and_shading_are_no_fixed_pattern() -> None:
    y, x = np.indices(SHAPE)
    fringes = 0.1 * np.cos(2 * np.pi * (x * np.cos(0.6) + y * np.sin(0.6)) / 17)
    shading = 0.2 * ((x / SHAPE[1] - 0.5) ** 2 - (y / SHAPE[0]) ** 2)
    found = pixel_pattern([seen(fringes + shading, np.zeros(SHAPE))])
    assert np.std(found["gain"]) < 0.06 * np.std(fringes + shading)


def test_fringes_do_not_hide_a_fixed_pattern() -> None:
    y, x = np.indices(SHAPE)
    fringes = 0.05 * np.cos(2 * np.pi * (x + 0.4 * y) / 13)
    gain = np.random.default_rng(2).normal(0, 0.03, SHAPE)
    found = pixel_pattern([seen(gain + fringes, np.zeros(SHAPE))])
    assert np.std(found["gain"] - gain) < 0.45 * 0.03
