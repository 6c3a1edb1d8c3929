"""The propagation methods that a model can select: Fresnel beside the angular spectrum, and the far field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import irradiance
from runtime.lightpath.light_path_adjoint import irradiance_and_pullback
from tests.trainer.hidden import bench_text
from trainer.captures.bench_file import Bench, read_bench
from trainer.model.bundle_export import export_bundle
from trainer.model.model import Model
from trainer.model.model_stages import scene_for, stages_for
from trainer.prediction.camera_light import light_on_camera
from trainer.prediction.predict import light_path, trace


def bench(side: int, distance_mm: float) -> Bench:
    import tomllib

    text = bench_text(width=side, height=side, distance_mm=distance_mm)
    return read_bench(tomllib.loads("schema = 1\n" + text))


def seen(model: Model, gray: np.ndarray) -> torch.Tensor:
    scene = scene_for(model, "green", model.bench.distance_mm, torch.float64)
    stages = stages_for(scene, model.present)
    patterns = torch.as_tensor(gray.astype(np.int64))[None]
    return light_on_camera(scene, stages, trace(scene, stages, patterns).image)[0]


def test_fresnel_agrees_where_its_sampling_holds():
    gray = np.random.default_rng(0).integers(0, 256, (64, 64))
    model = Model(bench(64, 8))
    exact, paraxial = seen(model, gray), seen(replace(model, method="fresnel"), gray)
    assert float(((exact - paraxial) ** 2).mean() / exact.var()) < 1e-3
    with pytest.raises(InputError, match="Fresnel propagation errs by .* below"):
        seen(replace(Model(bench(64, 500)), method="fresnel"), gray)


def test_a_flat_panel_in_the_far_field_is_the_sinc_of_its_aperture():
    side, distance = 32, 0.5
    model = replace(Model(bench(side, distance * 1e3)), method="fraunhofer")
    light = seen(model, np.zeros((side, side), int)).numpy()
    place = (np.arange(side) - (side - 1) / 2) * 8e-6
    width = side * 8e-6
    # The panel's field is band-limited by the iris, which changes its far field by a part in a few hundred.
    slit = (width / np.sqrt(520e-9 * distance) * np.sinc(width * place / (520e-9 * distance))) ** 2
    np.testing.assert_allclose(light, np.outer(slit, slit), rtol=0.02)


def test_the_far_field_has_an_adjoint():
    rng = np.random.default_rng(1)
    model = replace(Model(bench(16, 400)), method="fraunhofer")
    scene = scene_for(model, "green", 400, torch.float64)
    path = light_path(scene, stages_for(scene, ()))
    phase = torch.tensor(rng.normal(size=(16, 16)), requires_grad=True)
    weight = torch.tensor(rng.normal(size=scene.grid.image_shape))
    (irradiance(path, phase) * weight).sum().backward()
    torch.testing.assert_close(irradiance_and_pullback(path, phase.detach())[1](weight), phase.grad)


def test_the_far_field_says_where_it_holds_and_is_not_exported(tmp_path):
    model = replace(Model(bench(64, 30)), method="fraunhofer")
    with pytest.raises(InputError, match="holds beyond .* use angular_spectrum"):
        seen(model, np.zeros((64, 64), int))
    with pytest.raises(InputError, match="cannot be exported"):
        export_bundle(model, None, tmp_path / "bundle")
