"""What the camera's noise leaves in values that each pixel has for itself is known, and is nothing to explain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.diagnosis import diagnose
from trainer.diagnosis.explanation import explain
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.pixel_values import pixel_noise, with_pixel_values
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import fit_from
from trainer.model.model import Model, absent, instance_with


def captured(folder: Path, *defects: str, patterns: int = 6) -> CaptureSet:
    """Captures of a camera whose few electrons make much noise."""
    folder.mkdir(exist_ok=True)
    path = bench_file(folder, *defects)
    path.write_text(path.read_text().replace("full_well_e = 10500", "full_well_e = 2500"))
    acquire_from(str(path), folder / "captures", patterns=patterns)
    return read_captures(folder / "captures")


@pytest.mark.parametrize("drifts", [False, True])
def test_what_is_left_of_a_fixed_pattern_is_what_noise_leaves(drifts: bool, tmp_path: Path) -> None:
    """A drifting laser has a gain for each capture, which all pixels' gains together look like."""
    names = ["laser_drift"] * drifts + ["fixed_pattern"]
    captures = captured(tmp_path, *(f'kind = "{name}"' for name in names))
    roles = capture_roles(captures)
    model = with_gains(captures, Model(captures.bench), roles.fitted)
    batches = load(captures, roles.fitted)
    assert pixel_noise(captures, model) == 0.0
    for name in names:
        model = fit_from(model, absent(catalogue()[name], captures.bench), batches).model
    model = with_pixel_values(captures, model)
    left = evaluate_captures(captures, roles.held_out, model).excess
    assert left > 1e-3
    assert pixel_noise(captures, model) == pytest.approx(left, rel=0.15)


def test_a_fixed_pattern_behind_a_bent_response_is_read_by_what_it_does_to_counts(tmp_path: Path) -> None:
    """A pixel that is nearly full says little of its gain: of 3 %, 2.7 % were found where it was taken to say much."""
    captures = captured(
        tmp_path, 'kind = "sensor_response"', 'kind = "fixed_pattern"\noffset_counts = 1.0', patterns=9
    )
    roles = capture_roles(captures)
    model, batches = with_gains(captures, Model(captures.bench), roles.fitted), load(captures, roles.fitted)
    for name, order in (("sensor_response", 6), ("fixed_pattern", None)):
        model = fit_from(model, absent(catalogue()[name], captures.bench, order), batches).model
    values = with_pixel_values(captures, model).instance("fixed_pattern").values
    assert values["gain_rms"] == pytest.approx(3.0, rel=0.05)


def test_a_slow_panels_first_capture_says_nothing_of_pixels(tmp_path: Path) -> None:
    """Nobody knows what it showed before: with that capture, twice as much was left."""
    names = ("slow_response", "fixed_pattern")
    captures = captured(tmp_path, *(f'kind = "{name}"' for name in names))
    roles = capture_roles(captures)
    model = with_gains(captures, Model(captures.bench), roles.fitted)
    for name in names:
        start = absent(catalogue()[name], captures.bench)
        model = fit_from(model, start, load(captures, roles.fitted)).model
    model = with_pixel_values(captures, model)
    left = evaluate_captures(captures, roles.held_out, model).excess
    assert 1e-3 < left < 1.4 * pixel_noise(captures, model)

    def gains(one: Model) -> NDArray:
        return with_pixel_values(captures, one).instance("fixed_pattern").values["gain"]

    of_slow, of_quick = gains(model), gains(model.without("slow_response"))
    first = captures.captures[0].image
    Image.fromarray(np.asarray(Image.open(first)) // 2).save(first)
    captures = read_captures(captures.folder)
    np.testing.assert_array_equal(gains(model), of_slow)
    assert np.abs(gains(model.without("slow_response")) - of_quick).max() > 0.01


def test_a_slow_panels_only_capture_is_read_all_the_same(tmp_path: Path) -> None:
    every = captured(tmp_path, 'kind = "slow_response"', 'kind = "fixed_pattern"')
    first, other = every.captures[0], every.captures[2]
    captures = replace(every, captures=(first, other))
    roles = capture_roles(captures)
    assert roles.fitted == (first,) and roles.held_out == (other,)
    model = with_gains(captures, Model(captures.bench), roles.fitted)
    slow = instance_with(catalogue()["slow_response"], captures.bench, {"share": 0.08})
    model = model.having(slow).having(absent(catalogue()["fixed_pattern"], captures.bench))
    model = with_pixel_values(captures, model)
    assert np.abs(model.instance("fixed_pattern").values["gain"]).max() > 0
    assert pixel_noise(captures, model) > 0


def test_a_model_that_leaves_the_noise_of_pixels_is_complete_and_says_so(tmp_path: Path) -> None:
    captures = captured(tmp_path, 'kind = "fixed_pattern"')
    known = {name: catalogue()[name] for name in ("fixed_pattern", "illumination", "stray_light")}
    with open_pool(1) as pool:
        found = explain(captures, Model(captures.bench), known, pool)
        assert found.model.names == ("fixed_pattern",)
        assert found.steps[-1].held_out.excess > 1e-3  # five times what another effect would be worth
        assert found.diagnosis.verdict == "complete"
        assert found.diagnosis.thresholds.pixel_noise > 1e-3
        assert "The noise in each pixel's own values is" in found.diagnosis.sentence
        # What is really missing is still missing.
        dark = captured(tmp_path / "bent", 'kind = "fixed_pattern"', 'kind = "illumination"')
        lacking = diagnose(dark, found.model, known, pool, thorough=False)
    assert lacking.verdict == "missing" and lacking.best is not None
    assert lacking.best.effect.name == "illumination"
