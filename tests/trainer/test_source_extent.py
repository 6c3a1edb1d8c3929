"""A source with an extent: its directions move the picture and the light within the iris, and their irradiances add."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.trainer.hidden import LARGER, captured, ran
from tests.trainer.test_effects import bench, gray, present, scene_of
from trainer.model.model import EffectInstance, absent
from trainer.model.model_stages import stages_for
from trainer.prediction.predict import trace
from trainer.prediction.scene import Scene
from trainer.prediction.source_extent import lit_by_extent

EXTENT_Y, EXTENT_X = 0.8e-3, 0.5e-3  # rad, rms


def lit(scene: Scene, maps: torch.Tensor) -> torch.Tensor:
    """Irradiance of a Gaussian source where a point's is a square polynomial of the iris's place."""
    stages = stages_for(
        scene, (present("spatial_coherence", extent_y=1e3 * EXTENT_Y, extent_x=1e3 * EXTENT_X),)
    )
    return lit_by_extent(stages.pupil, lambda pupil: point_light(*pupil.centre, maps))[0]


def point_light(v: Any, u: Any, maps: Any) -> Any:
    return maps[0] + 40 * (v * maps[1] + u * maps[2]) + 800 * (v**2 * maps[3] + u**2 * maps[4])


def test_all_directions_add_as_irradiance() -> None:
    """Against the sum over the directions themselves, each with its own iris and its own displaced picture."""
    scene = scene_of(present("spatial_coherence", extent_y=1.0))
    height, width = scene.grid.image_shape
    draw = np.random.default_rng(0)
    smooth = np.exp(-0.5 * (np.fft.fftfreq(height)[:, None] ** 2 + np.fft.rfftfreq(width) ** 2) * 12**2)
    maps = np.fft.irfft2(smooth * np.fft.rfft2(draw.normal(size=(5, height, width))), (height, width))
    expected = np.zeros((height, width // 2 + 1), complex)
    fy, fx = (f.numpy() for f in (stages_for(scene, ()).pupil.iy, stages_for(scene, ()).pupil.ix))
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    reach = 1e-3 * scene.plane_mm
    for ty, wy in zip(nodes * EXTENT_Y, weights, strict=True):
        for tx, wx in zip(nodes * EXTENT_X, weights, strict=True):
            v, u = (
                -2 * 8e-6 * t / scene.wavelength for t in (ty, tx)
            )  # the iris from where tilted light goes
            moved = np.exp(-2j * math.pi * reach * (fy * ty + fx * tx))
            expected += wy * wx * moved * np.fft.rfft2(point_light(v, u, maps))
    expected = np.fft.irfft2(expected / weights.sum() ** 2, (height, width))
    found = lit(scene, torch.as_tensor(maps)).numpy()
    blurred = lit(scene, torch.as_tensor(maps * np.array([1, 0, 0, 0, 0])[:, None, None])).numpy()
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected - blurred).max()


def test_light_that_the_iris_cuts_from_aside_is_in_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A blur of the same shape leaves several times as much: it takes nothing at the iris's edge."""
    captures = captured(
        capsys,
        tmp_path,
        'kind = "spatial_coherence"\nrings = 4',
        options=("--patterns", 4),
        **LARGER,
    )
    left = {
        name: ran(capsys, "add", name, captures, "--out", tmp_path / f"{name}.toml")["after"]["excess"]
        for name in ("spatial_coherence", "sensor_blur")
    }
    assert left["spatial_coherence"] < 1e-4
    assert left["sensor_blur"] > 4 * left["spatial_coherence"]


@pytest.mark.parametrize(
    ("other", "start", "most"),
    [
        (present("illumination", log_amplitude=0.05), "panel", 0.03),
        (present("phase_response", gain=1.02), "drive", 0.05),
        (present("spatial_coherence", extent_y=0.82, extent_x=0.5), "pupil", 0.1),
        (present("spatial_coherence", extent_y=0.8, extent_x=0.5, halo=0.02), "pupil", 1e-9),
        (present("iris", half_width=0.85), "pupil", 1e-9),
    ],
    ids=lambda value: value.effect.name if isinstance(value, EffectInstance) else None,
)
def test_a_derivative_takes_light_from_aside_as_it_was_where_the_pupil_is_the_same(
    other: EffectInstance, start: str, most: float
) -> None:
    """It differs little from that of all five pictures, and not at all where the pupil is another one."""
    extent = present("spatial_coherence", extent_y=0.8, extent_x=0.5)
    scene = scene_of(extent, other)
    here = [extent, *([] if other.effect is extent.effect else [absent(other.effect, bench())])]
    there = [other if one.effect is other.effect else one for one in here]
    base = trace(scene, stages_for(scene, tuple(here)), gray()[:1])
    moved = stages_for(scene, tuple(there))
    near, whole = (
        trace(scene, moved, gray()[:1], start, base, nearby=nearby).image - base.image
        for nearby in (True, False)
    )
    assert float(whole.norm()) > 1e-4 * float(base.image.norm())
    assert float((near - whole).norm()) <= most * float(whole.norm())


@pytest.mark.parametrize("changed", ["spatial_coherence", "iris", "panel_wavefront"])
def test_a_points_picture_is_taken_from_before_only_where_it_is_the_same(changed: str) -> None:
    """Another extent moves the picture that a point gives; another pupil or panel makes another one."""
    extent = present("spatial_coherence", extent_y=0.8, extent_x=0.5)
    other = {
        "spatial_coherence": present("spatial_coherence", extent_y=0.3, extent_x=0.9),
        "iris": present("iris", half_width=0.85),
        "panel_wavefront": present("panel_wavefront", wavefront=np.array([0.0, 0.0, 0.5, 0.0, 0.2])),
    }[changed]
    scene = scene_of(extent, other)
    here = {one.effect.name: one for one in (extent, absent(other.effect, bench()))}
    here[extent.effect.name] = extent
    there = tuple({**here, changed: other}.values())
    with torch.no_grad():
        base = trace(scene, stages_for(scene, tuple(here.values())), gray()[:1])
        moved = stages_for(scene, there)
        found = trace(scene, moved, gray()[:1], other.effect.stage, base)
        whole = trace(scene, moved, gray()[:1])
    torch.testing.assert_close(found.image, whole.image, rtol=1e-5, atol=1e-6 * float(whole.image.max()))
    assert not torch.allclose(found.image, base.image, rtol=1e-3)
