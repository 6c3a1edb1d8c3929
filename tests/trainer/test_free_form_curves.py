"""Response curves go on in free form where their polynomials end, and everything that reads a model sees them whole."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from firmware_iface.virtual import BenchDescription, VirtualHeadset, make_defect
from firmware_iface.virtual.simulated_drive import Drive
from trainer.captures import acquire
from trainer.captures.acquire import acquire_captures
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.open_bench import nominal_bench
from trainer.diagnosis.addition import Addition, add
from trainer.effects import testing
from trainer.effects.effect_catalogue import catalogue
from trainer.effects.free_form import along, on_other_curve_nodes
from trainer.fitting import free_form_effects
from trainer.fitting.free_form_effects import with_free_form
from trainer.fitting.gains import with_gains
from trainer.fitting.predictor import excess_on
from trainer.formatting import change_of
from trainer.model.bundle_export import acting_on_display, baked_path
from trainer.model.history import recorded
from trainer.model.model import Model, absent
from trainer.model.model_file import read_model, write_model
from trainer.model.parameters import describe

# A curve that breaks at one level: no polynomial has its kink.
KINKED = {
    "sensor_response": {"sharpness": 20.0, "knee_share": 0.3},
    "phase_response": {"kink": 0.2, "kink_at": 0.12, "s_curvature": 0.0, "lopsidedness": 0.0},
}


def described(kind: str) -> BenchDescription:
    return BenchDescription("kinked", defects=(make_defect(kind, **KINKED[kind]),)).resized(72, 96, 8.0)


@pytest.fixture
def exposed_to_the_top(monkeypatch: pytest.MonkeyPatch) -> None:
    """Captures are exposed as if pixels were full at the top count alone: the kink lies below the brightest light."""
    monkeypatch.setattr(acquire, "may_be_full", lambda *_: False)


def captured(kind: str, folder: Path) -> CaptureSet:
    headset = VirtualHeadset(described(kind), seed=3)
    acquire_captures(headset, nominal_bench(headset), folder / "captures", patterns=9)
    return read_captures(folder / "captures")


def fitted(captures: CaptureSet, kind: str, free: bool = True) -> Addition:
    effect = catalogue()[kind]
    return add(captures, Model(captures.bench), effect if free else replace(effect, free_form=None))


@pytest.mark.usefixtures("exposed_to_the_top")
def test_a_kinked_camera_response_ends_at_the_noise(tmp_path: Path) -> None:
    captures = captured("sensor_response", tmp_path)
    polynomials = fitted(captures, "sensor_response", free=False).after.excess
    whole = fitted(captures, "sensor_response")
    assert whole.before.excess > 1 and polynomials > 5e-3
    assert whole.after.excess < 5e-4
    present = whole.model.instance("sensor_response")
    assert present.order == max(present.effect.orders) and present.nodes is not None
    assert f"and a curve of {present.nodes.shape[1]} nodes" in describe(present, captures.bench)


def test_a_kinked_phase_response_is_the_benchs_own_and_goes_into_the_bundle(tmp_path: Path) -> None:
    captures = captured("phase_response", tmp_path)
    whole = fitted(captures, "phase_response")
    polynomials = fitted(captures, "phase_response", free=False)
    assert whole.after.excess < 1.5e-4 < 0.6 * polynomials.after.excess
    # What the bench really does to each gray level, less a constant, which no camera sees.
    true = Drive(described("phase_response"), 520.0).magnitude(np.arange(256.0)[None, :])[0]

    def wrong(model: Model) -> float:
        path = baked_path(acting_on_display(model), "green", captures.bench.distance_mm)
        off = np.asarray(path.response) - true
        return float(np.std(off[2:-2]))

    assert wrong(whole.model) < 0.005 < 0.5 * wrong(polynomials.model)
    # The file gives back the same light path.
    write_model(tmp_path / "model.toml", whole.model)
    again = read_model(tmp_path / "model.toml", catalogue())
    assert wrong(again) == wrong(whole.model)


def test_nothing_goes_on_where_the_polynomials_hold_the_curve(tmp_path: Path) -> None:
    effect = catalogue()["sensor_response"]
    captures = testing.captures_with(tmp_path, effect, {"bend": np.array([0.3, -0.1])})
    found = add(captures, Model(captures.bench), effect)
    assert found.after.excess < 1e-4
    assert found.model.instance("sensor_response").nodes is None


@pytest.mark.parametrize("kind", ["phase_response", "amplitude_modulation", "sensor_response"])
def test_a_curve_moves_what_its_effect_moves_and_zero_nodes_move_nothing(kind: str, tmp_path: Path) -> None:
    bench = testing.small_bench()
    effect = catalogue()[kind]
    gray = np.random.default_rng(0).integers(0, 256, bench.panel.shape)
    light = []
    for size in (0.0, 0.2):
        nodes = size * np.sin(np.linspace(0, 7, 12))[None, :]
        model = Model(bench, (replace(absent(effect, bench), nodes=nodes),))
        light.append(testing._predict(model, model.present, gray=gray))
    plain = testing._predict(Model(bench), (), gray=gray)
    assert torch.allclose(light[0], plain, rtol=1e-4, atol=1e-4 * float(plain.max()))
    assert float((light[1] - plain).abs().max()) > 0.02 * float(plain.max())


def test_other_nodes_give_the_same_curve_and_values_between_samples_are_straight() -> None:
    nodes = np.random.default_rng(1).normal(size=(2, 9))
    finer = on_other_curve_nodes(nodes, 15)
    back = on_other_curve_nodes(finer, 9)
    assert finer.shape == (2, 15) and np.allclose(back, nodes, atol=0.2)
    curve = torch.linspace(0, 1, 2049) ** 2
    share = torch.tensor([-0.3, 0.0, 0.123, 0.777, 1.0, 1.2])
    assert torch.allclose(along(curve, share), share.clamp(0, 1) ** 2, atol=1e-6)


def test_the_history_says_that_a_curve_went_on(tmp_path: Path) -> None:
    bench = testing.small_bench()
    effect = catalogue()["sensor_response"]
    captures = testing.captures_with(tmp_path, effect, {})
    errors = add(captures, Model(bench), effect).after
    model = Model(bench, (replace(absent(effect, bench), nodes=np.zeros((1, 27))),))
    record = recorded(model, None, errors, refined="sensor_response").history[-1]
    assert change_of(record) == "curve of sensor_response"


def test_a_curve_that_removes_next_to_nothing_is_given_up_before_the_rest_is_fitted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shifted picture: the curve of the camera's response has no part in it."""
    refits: list[Any] = []
    monkeypatch.setattr(free_form_effects, "fit", lambda *given, **_: refits.append(given))
    captures = testing.captures_with(tmp_path, catalogue()["misregistration"], {"shift_x": 0.6}, 6)
    effect = catalogue()["sensor_response"]
    model = Model(captures.bench).having(absent(effect, captures.bench, max(effect.orders)))
    model = with_gains(captures, model, captures.captures)
    batches = [load(captures, captures.captures[:4]), load(captures, captures.captures[4:])]
    assert with_free_form(model, effect.name, *batches, 0.0) is None
    assert not refits


@pytest.mark.usefixtures("exposed_to_the_top")
def test_nodes_stay_where_few_captures_mislead_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a fit of the other numbers that leaves more on the captures that stop it, nothing is kept."""
    captures = captured("sensor_response", tmp_path)
    polynomials = fitted(captures, "sensor_response", free=False).model
    present = replace(polynomials.instance("sensor_response"), effect=catalogue()["sensor_response"])
    model = polynomials.having(present)
    batches = [load(captures, captures.captures[:6]), load(captures, captures.captures[6:])]

    def misled(model: Model, *_: Any, **__: Any) -> SimpleNamespace:
        return SimpleNamespace(model=replace(model, gain={c: 1.3 * g for c, g in model.gain.items()}))

    monkeypatch.setattr(free_form_effects, "fit", misled)
    found = with_free_form(model, "sensor_response", *batches, 0.0)
    assert found is not None and found.instance("sensor_response").nodes is not None
    assert excess_on(found, batches[1]) < 0.5 * excess_on(model, batches[1])
