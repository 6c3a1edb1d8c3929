"""The light of each capture, measured from the capture itself where the laser drifts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.trainer.hidden import bench_file
from tests.trainer.test_effects import gray, predicted, present, scene_of
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import read_captures
from trainer.diagnosis.explanation import explain
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gauss_newton import fit
from trainer.fitting.jacobian import column_step, columns, keys_of, stepped
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model, absent
from trainer.model.model_stages import stages_for
from trainer.prediction.camera_light import counts, light_on_camera
from trainer.prediction.predict import trace


def test_laser_drift_is_a_switch_and_the_gain_is_measured() -> None:
    drift = present("laser_drift", spread=3.0)
    scene = scene_of(drift)
    truth = predicted(scene, stages_for(scene, ()))
    measured = truth * torch.tensor([1.1, 0.9], dtype=torch.float64)[:, None, None]
    weight = torch.ones_like(truth)
    own = predicted(scene, stages_for(scene, (drift,)), (measured, weight))
    torch.testing.assert_close(own, measured)
    held = predicted(scene, stages_for(scene, (present("laser_drift", spread=0.0),)), (measured, weight))
    torch.testing.assert_close(held, truth)


def test_the_drifting_gain_is_one_of_light_where_counts_are_not_proportional_to_it() -> None:
    bent = present("sensor_response", bend=np.array([-0.9, 0.2]), order=2)
    scene = scene_of(bent)
    light = light_on_camera(scene, stages_for(scene, ()), trace(scene, stages_for(scene, ()), gray()).image)
    brightness = torch.full((2, 1, 1), 400.0, dtype=torch.float64)
    drifting = brightness * torch.tensor([1.3, 0.6], dtype=torch.float64)[:, None, None]
    truth = counts(scene, stages_for(scene, (bent,)), light, drifting, None)
    both = stages_for(scene, (present("laser_drift", spread=3.0), bent))
    found = counts(scene, both, light, brightness, (truth, torch.ones_like(truth)))
    torch.testing.assert_close(found, truth, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("bent", [(), (-0.9, 0.2)], ids=["straight", "bent"])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_light_that_is_added_drifts_as_far_as_it_is_the_lasers(share: float, bent: tuple[float, ...]) -> None:
    stray = present("stray_light", counts=np.array([60.0, 20.0, -30.0]), laser_share=share, order=1)
    effects = (present("sensor_response", bend=np.array(bent), order=2),) if bent else ()
    scene = scene_of(stray, *effects)
    with_light = stages_for(scene, (stray, *effects))
    light = light_on_camera(scene, with_light, trace(scene, with_light, gray()).image)
    brightness = torch.full((2, 1, 1), 400.0, dtype=torch.float64)
    power = torch.tensor([1.3, 0.6], dtype=torch.float64)[:, None, None]
    added = with_light.sensor.offset
    assert added is not None
    bare = replace(
        with_light, sensor=replace(with_light.sensor, offset=None, laser_share=None, response=None)
    )
    truth = counts(scene, bare, light, power * brightness, None) + (1 - share + share * power) * added
    if (response := with_light.sensor.response) is not None:
        truth = response(truth / with_light.sensor.full_scale) * with_light.sensor.full_scale
    drifting = stages_for(scene, (stray, present("laser_drift", spread=3.0), *effects))
    found = counts(scene, drifting, light, brightness, (truth, torch.ones_like(truth)))
    torch.testing.assert_close(found, truth, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("bent", [(), (-0.9, 0.2)], ids=["straight", "bent"])
def test_each_captures_own_gain_follows_in_derivatives(bent: tuple[float, ...], tmp_path: Path) -> None:
    """Where the model is right, what a number does to predictions is what it does with gains found anew."""
    hidden = ('kind = "laser_drift"\nsine_share = 0.3', *(['kind = "sensor_response"'] if bent else ()))
    acquire_from(str(bench_file(tmp_path, *hidden)), tmp_path / "captures", patterns=4)
    captures = read_captures(tmp_path / "captures")
    (batch,) = load(captures, captures.captures)
    model = Model(captures.bench)
    moved = ("distance", "vignetting", *(["sensor_response"] if bent else ()))
    for name in ("laser_drift", *moved):
        model = model.having(absent(catalogue()[name], captures.bench))
    model = fit(model, model.names, [batch]).model
    predictor, keys = Predictor(model, batch), keys_of(model, moved)
    with torch.no_grad():
        _, slopes = columns(model, keys, predictor, predictor.trace(model))
        for key, slope in zip(keys, slopes, strict=False):
            step = column_step(model, key)
            anew = (predictor.predict(stepped(model, key, step)) - predictor.predict(model)) / step
            off = float(torch.linalg.vector_norm(slope - anew)) / float(torch.linalg.vector_norm(anew))
            assert off < 0.1, key  # of secants one step wide; 0.1 to 2.3 where the gains are held


@pytest.mark.parametrize("room", [False, True], ids=["of the laser", "of the room"])
def test_glare_is_told_from_light_of_the_room(room: bool, tmp_path: Path) -> None:
    """On the bench all light is the laser's; light of the room is always the same."""
    glows = () if room else ('kind = "stray_light"\nradius_share = 3',)
    acquire_from(str(bench_file(tmp_path, *glows, 'kind = "laser_drift"')), tmp_path / "captures")
    if room:
        y, x = np.mgrid[-1:1:80j, -1:1:96j]
        electrons, rng = 10500 / (4095 - 64), np.random.default_rng(3)  # a count
        for file in (tmp_path / "captures" / "image").iterdir():
            glow = rng.poisson((120 + 40 * y - 30 * x) * electrons) / electrons
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            assert cv2.imwrite(str(file), np.clip(np.rint(image + glow), 0, 4095).astype(image.dtype))
    captures = read_captures(tmp_path / "captures")
    names = ("laser_drift", "stray_light", "illumination", "vignetting", "zero_order")
    few = {name: catalogue()[name] for name in names}
    with open_pool(1) as pool:
        found = explain(captures, Model(captures.bench), few, pool)
    assert set(found.model.names) == {"laser_drift", "stray_light"} and found.diagnosis.verdict == "complete"
    stray = found.model.instance("stray_light")
    assert float(stray.values["laser_share"]) == pytest.approx(0.0 if room else 1.0, abs=0.02)
    assert stray.errors is not None and float(stray.errors["laser_share"]) < 0.02
    assert float(stray.errors["counts"][0]) < 0.02 * float(stray.values["counts"][0])
    if room:
        assert float(stray.values["counts"][0]) == pytest.approx(120, rel=0.02)
