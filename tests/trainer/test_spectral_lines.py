"""A laser's line is a sum of wavelengths."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.trainer.test_effects import predicted, present, scene_of
from trainer.model.model_stages import stages_for


def test_a_line_has_the_width_that_it_says() -> None:
    lines = stages_for(scene_of(), (present("temporal_coherence", line_width=4.0),)).pupil.lines
    assert lines is not None
    offsets, weights = lines
    assert float(weights.sum()) == pytest.approx(1)
    spread = math.sqrt(float((weights * offsets**2).sum()))
    assert spread * 2 * math.sqrt(2 * math.log(2)) == pytest.approx(4e-9)


def test_a_broad_line_is_as_smooth_as_many_wavelengths() -> None:
    """Far from the panel the wavelengths of a broad line displace fine detail by pixels, and five show apart."""
    width, plane = 15.0, 15.0
    scene = scene_of(plane=plane)

    def of_lines(count: int) -> Tensor:
        nodes = torch.linspace(-3.5, 3.5, count, dtype=torch.float64)
        weights = torch.exp(-0.5 * nodes**2)
        bare = stages_for(scene, ())
        lines = bare.pupil.emitting(nodes * 1e-9 * width / 2.3548, weights / weights.sum())
        return predicted(scene, replace(bare, pupil=lines))

    smooth = of_lines(41)
    found = predicted(scene, stages_for(scene, (present("temporal_coherence", line_width=width),)))
    off, five = (float(((c - smooth) ** 2).mean() / smooth.var()) for c in (found, of_lines(5)))
    assert off < 1e-5
    assert five > 30 * off
