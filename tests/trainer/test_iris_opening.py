"""What an iris passes of each frequency: its area, and the same with derivatives and without."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tests.trainer.test_effects import present, scene_of
from trainer.model.model_stages import stages_for
from trainer.prediction.pupil_modes import iris_opening

SHAPES = {
    "round": {"roundness": 1.0},
    "oblong": {"roundness": 1.0, "stretch": 0.3},
    "turned": {"roundness": 1.0, "stretch": -0.2, "rotation": 25.0},
    "round corners": {"roundness": 0.4, "stretch": 0.1},
    "turned square": {"rotation": 30.0},
    "soft": {"roundness": 0.7, "edge": 0.1},
    "soft square": {"edge": 0.15, "stretch": 0.2},
}


@pytest.mark.parametrize("shape", SHAPES)
def test_without_derivatives_only_samples_on_the_edge_are_computed_and_nothing_changes(shape: str) -> None:
    iris = present("iris", half_width=0.6, centre_y=0.07, centre_x=-0.11, **SHAPES[shape])
    scene = scene_of(iris)
    pupil = stages_for(scene, (iris,)).pupil
    with_slopes = replace(pupil, half_width=pupil.half_width.clone().requires_grad_())
    quick, whole = iris_opening(scene, pupil), iris_opening(scene, with_slopes)
    assert whole.requires_grad and not quick.requires_grad
    torch.testing.assert_close(quick, whole.detach(), rtol=0, atol=1e-12)
    assert 0 < float(((quick > 0) & (quick < 1)).double().mean()) < 0.25


@pytest.mark.parametrize(
    ("roundness", "stretch", "rotation"), [(1.0, 0.0, 0.0), (1.0, 0.3, 40.0), (0.5, 0.2, 0.0)]
)
def test_an_iris_passes_as_much_as_its_area(roundness: float, stretch: float, rotation: float) -> None:
    half = 0.55
    iris = present("iris", half_width=half, roundness=roundness, stretch=stretch, rotation=rotation)
    scene = scene_of(iris)
    opening = iris_opening(scene, stages_for(scene, (iris,)).pupil)
    rows, columns = half * (1 - stretch), half * (1 + stretch)
    corners = (4 - math.pi) * roundness**2 * rows * columns
    rows, columns = (
        side + (1 - roundness) / (2 * n)
        for side, n in zip((rows, columns), scene.bench.panel.shape, strict=True)
    )
    area = 4 * rows * columns - corners
    sample = math.prod(2 / n for n in scene.grid.padded)
    assert float(opening.sum()) * sample == pytest.approx(area, rel=0.005)
