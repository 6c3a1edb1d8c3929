"""Crosstalk: how much each pixel and its neighbours have in the phase of a sub-pixel."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests.trainer.test_effects import present, scene_of
from trainer.model.model_stages import stages_for


def test_crosstalk_shares_out_the_phase_of_each_pixel_and_no_more() -> None:
    drive = stages_for(scene_of(), (present("crosstalk", width_y=0.3, width_x=0.2, asymmetry_x=0.5),)).drive
    assert drive.crosstalk is not None
    rows, columns = drive.crosstalk
    for taps in (rows, columns):
        torch.testing.assert_close(taps.sum(1), torch.ones(taps.shape[0], dtype=taps.dtype))
        assert bool((taps >= 0).all())
    torch.testing.assert_close(rows, rows.flip(0, 1))  # even without asymmetry
    reach = torch.arange(columns.shape[1], dtype=columns.dtype) - columns.shape[1] // 2
    assert abs(float((columns * reach).sum())) > 0.01  # and to one side with it


@pytest.mark.parametrize("width", [0.15, 0.6])
def test_crosstalk_is_the_fields_decay_averaged_over_each_sub_pixel(width: float) -> None:
    """At a step of the phase, against a sum of the kernel over ten thousand points of a pixel."""
    asymmetry = 0.4
    one = present("crosstalk", width_y=width, width_x=width, asymmetry_x=asymmetry)
    drive = stages_for(scene_of(), (one,)).drive
    assert drive.crosstalk is not None
    taps = drive.crosstalk[1].numpy()
    sub, reach = taps.shape[0], taps.shape[1] // 2
    step = 10_000
    x = (np.arange(-12 * step, 12 * step) + 0.5) / step
    side = width / math.sqrt(2)
    kernel = np.exp(-np.where(x > 0, x / (side * (1 + asymmetry)), -x / (side * (1 - asymmetry))))
    above_step = np.cumsum(kernel) / kernel.sum()  # at x, of a phase that is 1 where x > 0
    for k in range(sub):  # of the first pixel above the step, and so on
        for pixel in (-1, 0, 1):
            low, high = pixel + k / sub, pixel + (k + 1) / sub
            expected = above_step[(x > low) & (x < high)].mean()
            # the pixels above the step, as far as they are seen from this one
            share = taps[k, max(0, reach - pixel) :].sum()
            assert share == pytest.approx(expected, abs=2e-3)
