"""How much each capture is blurred is read off the capture itself."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter

from trainer.prediction.capture_motion import blurred_spectrum
from trainer.prediction.stages import Sensor

SIDE, USUAL_PX = 96, 0.4  # of the picture; rms of the usual blur


def gaussian(sensor_iy: torch.Tensor, sensor_ix: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    w2 = (2 * math.pi * USUAL_PX) ** 2 * (sensor_iy**2 + sensor_ix**2)
    return torch.exp(-0.5 * variance * w2)


@pytest.mark.parametrize("share", [0.0, 0.7, 1.6, 2.4, 4.0])
def test_a_captures_blur_is_found_however_much_wider_than_the_usual_one(share: float) -> None:
    iy, ix = torch.fft.fftfreq(SIDE)[:, None], torch.fft.rfftfreq(SIDE)[None]
    nothing = torch.zeros(SIDE, SIDE)
    sensor = Sensor("green", 1.0, nothing, nothing, iy, ix, capture_blur=lambda v: gaussian(iy, ix, v))
    sharp = torch.rand(1, SIDE, SIDE, generator=torch.Generator().manual_seed(4))
    blurred = torch.as_tensor(gaussian_filter(sharp[0].numpy(), share * USUAL_PX, mode="wrap", truncate=8))[
        None
    ]
    found = blurred_spectrum(
        sensor,
        torch.fft.rfft2(sharp),
        lambda spectrum: torch.fft.irfft2(spectrum, s=(SIDE, SIDE)),
        (3 * blurred, torch.ones_like(blurred)),  # the exposure is not known
    )
    left = torch.fft.irfft2(found, s=(SIDE, SIDE)) - blurred
    assert left.square().mean() < 2e-3 * sharp.var()
