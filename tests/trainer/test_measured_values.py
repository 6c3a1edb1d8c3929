"""What effects read off the captures: a fixed pattern of pixels, and not what their neighbours tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import shift

from trainer.effects import measured_values
from trainer.effects.measured_values import blur_rms, pixel_pattern

SHAPE = (96, 120)


@dataclass
class Pictures:
    signal: torch.Tensor
    noise: torch.Tensor
    mask: torch.Tensor
    ids: tuple[str, ...] = ("000",)


@dataclass
class Seen:
    batch: Pictures
    prediction: torch.Tensor
    straight: torch.Tensor | None = None
    slope: torch.Tensor | None = None


def seen(gain: np.ndarray, offset: np.ndarray, pictures: int = 12, noise: float = 1.0) -> Any:
    """Pictures of random light by a camera whose pixels have these gains and offsets."""
    draw = np.random.default_rng(8)
    light = draw.gamma(1.5, 200.0, (pictures, *gain.shape))
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


@pytest.mark.parametrize("shape", [SHAPE, (300, 400)])
def test_fringes_do_not_hide_a_fixed_pattern(shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Also on a large picture, where the neighbours' weights are found from some of its pixels."""
    monkeypatch.setattr(measured_values, "WEIGHT_PIXELS", 30_000)
    y, x = np.indices(shape)
    fringes = 0.05 * np.cos(2 * np.pi * (x + 0.4 * y) / 13)
    gain = np.random.default_rng(2).normal(0, 0.03, shape)
    found = pixel_pattern([seen(gain + fringes, np.zeros(shape))])
    assert np.std(found["gain"] - gain) < 0.45 * 0.03


def test_the_middle_of_a_large_picture_tells_its_blur() -> None:
    rms, side = 0.9, measured_values.BLUR_PIXELS + 188
    sharp = np.random.default_rng(3).gamma(1.5, 200.0, (side, side))
    swing = [
        shift(sharp, (0, rms * np.sqrt(2) * np.sin(t)), mode="wrap")
        for t in np.linspace(0, 2 * np.pi, 13)[:-1]
    ]
    blurred, ones = np.mean(swing, 0), np.ones(sharp.shape)
    one = Seen(Pictures(*(torch.tensor(a[None]) for a in (blurred, ones, ones))), torch.tensor(sharp[None]))
    assert blur_rms([one])["rms"] == pytest.approx(rms, rel=0.15)
