"""How much each capture is displaced and blurred is read off the capture itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import fourier_shift, gaussian_filter, shift

from trainer.prediction.capture_motion import measured_motion, motion_nearby
from trainer.prediction.stages import Sensor

SIDE, USUAL_PX = 96, 0.4  # of the picture; rms of the usual blur
IY, IX = torch.fft.fftfreq(SIDE)[:, None], torch.fft.rfftfreq(SIDE)[None]


def gaussian(variance: torch.Tensor) -> torch.Tensor:
    w2 = (2 * math.pi * USUAL_PX) ** 2 * (IY**2 + IX**2)
    return torch.exp(-0.5 * variance * w2)


def sensor_that(*, moves: bool = False, blurs: bool = False) -> Sensor:
    nothing = torch.zeros(SIDE, SIDE)
    blur = gaussian if blurs else None
    return Sensor("green", 1.0, nothing, nothing, IY, IX, capture_blur=blur, free_capture_shift=moves)


def read(spectrum: torch.Tensor) -> torch.Tensor:
    return torch.fft.irfft2(spectrum, s=(SIDE, SIDE))


def speckle(seed: int) -> torch.Tensor:
    return torch.rand(1, SIDE, SIDE, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("share", [0.0, 0.7, 1.6, 2.4, 4.0, 7.0])
def test_a_captures_blur_is_found_however_much_wider_than_the_usual_one(share: float) -> None:
    sharp = speckle(4)
    blurred = read(torch.fft.rfft2(sharp) * gaussian(torch.tensor(share**2)))
    measured = (3 * blurred, torch.ones_like(sharp))  # the exposure is not known
    motion = measured_motion(sensor_that(blurs=True), torch.fft.rfft2(sharp), read, measured)
    assert motion.blur is not None
    assert motion.blur.item() == pytest.approx(share, rel=0.015, abs=0.01)


@pytest.mark.parametrize("moved", [(0.1, -0.2), (0.8, 0.9), (-2.3, 5.6)])
def test_a_displacement_is_found_however_many_speckles_it_is(moved: tuple[float, float]) -> None:
    """Speckle of a pixel's size says nothing of where it is when it is a pixel off."""
    fine = gaussian_filter(speckle(4)[0].numpy(), 0.6, mode="wrap")
    seen = torch.as_tensor(fourier_shift(np.fft.fft2(fine), moved))
    measured = (3 * torch.fft.ifft2(seen).real.float()[None], torch.ones(1, SIDE, SIDE))
    spectrum = torch.fft.rfft2(torch.as_tensor(fine)[None])
    motion = measured_motion(sensor_that(moves=True), spectrum, read, measured)
    assert motion.shift is not None
    assert motion.shift[0].tolist() == pytest.approx([-moved[0], -moved[1]], abs=0.01)


def test_of_the_places_where_a_grating_looks_alike_the_nearest_is_found() -> None:
    lines = (0.5 + 0.5 * torch.cos(2 * math.pi * torch.arange(SIDE) / 4)).expand(1, SIDE, SIDE)
    spectrum = torch.fft.rfft2(lines)
    moved = torch.polar(torch.ones(SIDE, SIDE // 2 + 1), 2 * math.pi * (1.2 * IX + 0 * IY))
    measured = (2 * read(spectrum * moved), torch.ones(1, SIDE, SIDE))
    motion = measured_motion(sensor_that(moves=True), spectrum, read, measured)
    assert motion.shift is not None
    assert motion.shift[0].tolist() == pytest.approx([0, 1.2], abs=0.01)


@pytest.mark.parametrize("share", [0.5, 1.6])
def test_a_blur_is_found_through_a_bent_response_and_added_light(share: float) -> None:
    """Counts of bright places that are too low look like a wider blur."""
    sharp = speckle(4)
    light = 0.8 * read(torch.fft.rfft2(sharp) * gaussian(torch.tensor(share**2))) + 0.1

    def bent(share: torch.Tensor) -> torch.Tensor:
        return 1 - torch.exp(-1.5 * share)

    sensor = sensor_that(blurs=True).responding(bent).brightened(torch.full((SIDE, SIDE), 0.1))
    measured = (bent(light), torch.ones_like(light))
    motion = measured_motion(sensor, torch.fft.rfft2(sharp), read, measured)
    assert motion.blur is not None
    assert motion.blur.item() == pytest.approx(share, rel=0.015)


@pytest.mark.parametrize(
    ("kinds", "own"),
    [
        ({"blurs": True}, {"blur": 1.03}),
        ({"moves": True}, {"move": (0.03, -0.02)}),
        ({"moves": True, "blurs": True}, {"blur": 1.03, "move": (0.03, -0.02)}),
    ],
)
def test_near_a_model_a_captures_motion_takes_up_what_looks_like_more_of_it(
    kinds: dict[str, bool], own: dict[str, tuple[float, float] | float]
) -> None:
    """A model changes, a little, as its captures' motions do and besides in its own way: only the latter is left."""
    sensor, sharp = sensor_that(**kinds), speckle(4)
    seen = shift(gaussian_filter(sharp[0].numpy(), USUAL_PX, mode="wrap"), (0.2, 0.1), order=5, mode="wrap")
    measured = (3 * torch.as_tensor(seen)[None], torch.ones_like(sharp))
    spectrum = torch.fft.rfft2(sharp)
    motion = measured_motion(sensor, spectrum, read, measured)
    near = motion_nearby(sensor, spectrum, read, measured, motion)
    before = read(spectrum * motion.filter(sensor))
    assert torch.allclose(near.light_of(sensor, spectrum, read), before, atol=1e-6)

    dy, dx = own.get("move", (0.0, 0.0))
    like_motion = torch.polar(torch.ones(SIDE, SIDE // 2 + 1), 2 * math.pi * (IY * dy + IX * dx))
    like_motion = like_motion * gaussian(torch.tensor(own.get("blur", 1.0) ** 2 - 1))
    changed = spectrum * like_motion + 0.01 * torch.fft.rfft2(speckle(5))
    held = read(changed * motion.filter(sensor))
    again = measured_motion(sensor, changed, read, measured)
    exactly = read(changed * again.filter(sensor))
    error = (near.light_of(sensor, changed, read) - exactly).norm()
    assert error < 0.1 * (held - exactly).norm()


@pytest.mark.parametrize("dead_pixel", [False, True])
def test_a_change_that_is_one_of_the_captures_motions_is_none(dead_pixel: bool) -> None:
    """What rounding leaves of it would let a fit walk far with a number that captures say nothing of."""
    sensor, spectrum = sensor_that(moves=True), torch.fft.rfft2(speckle(4))
    gain = torch.ones(SIDE, SIDE)
    if dead_pixel:
        gain[3, 5] = 0
        sensor = sensor.multiplied(gain)
    seen = torch.polar(torch.ones(SIDE, SIDE // 2 + 1), 2 * math.pi * (0.3 * IY - 0.2 * IX))
    measured = (3 * gain * read(spectrum * seen), torch.ones(1, SIDE, SIDE))
    motion = measured_motion(sensor, spectrum, read, measured)
    near = motion_nearby(sensor, spectrum, read, measured, motion)
    farther = torch.polar(torch.ones(SIDE, SIDE // 2 + 1), 2 * math.pi * (0.005 * IY - 0.003 * IX))
    before, after = (gain * near.light_of(sensor, s, read) for s in (spectrum, spectrum * farther))
    assert (after - before).norm() < 1e-6 * before.norm()
