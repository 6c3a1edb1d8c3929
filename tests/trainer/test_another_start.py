"""An effect that ended in the wrong place is found by starting anew; one that is right comes back."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.another_start import fewer_from_another_start
from trainer.diagnosis.candidate_fits import CandidateFit, try_again
from trainer.diagnosis.explanation import explain
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.history import ANEW
from trainer.model.model import Model, absent, instance_with

GAIN = 1.1
SLIGHT_RESPONSE = 'kind = "phase_response"\ngain = 0.94\ns_curvature = 0.1\nlopsidedness = 0.01'


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    folder = tmp_path_factory.mktemp("start")
    bench = bench_file(folder, f'kind = "phase_response"\ngain = {GAIN}\ns_curvature = 0.0')
    acquire_from(str(bench), folder / "captures", patterns=6)
    return read_captures(folder / "captures")


def from_gain(captures: CaptureSet, gain: float) -> tuple[Model, CandidateFit | None]:
    """The response fitted from a gain, and what starting anew makes of it."""
    roles = capture_roles(captures)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    start = instance_with(catalogue()["phase_response"], captures.bench, {"gain": [gain]})
    model = fit(ideal.having(start), ["phase_response"], load(captures, roles.fitted)).model
    ids, held = (tuple(c.capture for c in some) for some in (roles.fitted, roles.held_out))
    return model, try_again(roles.folder, ids, held, model, "phase_response")


def test_a_response_that_ended_a_turn_too_high_starts_anew(captures: CaptureSet) -> None:
    stuck, again = from_gain(captures, 2.1)
    assert abs(float(stuck.instance("phase_response").values["gain"][0]) - GAIN) > 0.3
    assert again is not None
    assert float(again.model.instance("phase_response").values["gain"][0]) == pytest.approx(GAIN, abs=0.01)
    assert again.held_out.excess < 0.01


def test_what_comes_back_is_left_alone(captures: CaptureSet) -> None:
    right, again = from_gain(captures, 1.05)
    assert float(right.instance("phase_response").values["gain"][0]) == pytest.approx(GAIN, abs=0.01)
    assert again is None


def test_an_explanation_leaves_a_wrong_place_where_no_other_effect_is_expected_to_help(
    captures: CaptureSet,
) -> None:
    stuck, _ = from_gain(captures, 2.1)
    known = {name: catalogue()[name] for name in ("phase_response", "distance", "misregistration")}
    with open_pool(1) as pool:
        found = explain(captures, stuck, known, pool)
    step = found.steps[1]
    assert (step.refined, step.form) == ("phase_response", ANEW)
    assert found.model.history[-1]["form"] == ANEW["form"]
    assert found.model.names == ("phase_response",) and found.diagnosis.verdict == "complete"
    assert float(found.model.instance("phase_response").values["gain"][0]) == pytest.approx(GAIN, abs=0.01)


@pytest.mark.parametrize(
    ("hidden", "goes"),
    [
        (('kind = "polarisation_leak"\namplitude = 0.13', SLIGHT_RESPONSE), True),
        (('kind = "polarisation_leak"', 'kind = "amplitude_modulation"\nfall = 0.3'), False),
    ],
)
def test_an_effect_goes_that_another_one_in_a_wrong_place_needed(
    hidden: tuple[str, str], goes: bool, tmp_path: Path
) -> None:
    """A strong leak that follows the pattern is a panel that absorbs less; so one of these makes up for the other."""
    acquire_from(str(bench_file(tmp_path, *hidden)), tmp_path / "captures", patterns=6)
    captures = read_captures(tmp_path / "captures")
    roles = capture_roles(captures)
    known, batches = catalogue(), load(captures, roles.fitted)
    wrong = {"real": [-0.62], "imaginary": [-0.44], "gain": [0.9]}
    right = {"real": [0.1], "imaginary": [0.1], "gain": [0.35]}
    leak = instance_with(known["polarisation_leak"], captures.bench, wrong if goes else right)
    model = with_gains(captures, Model(captures.bench), roles.fitted).having(leak)
    for name, order in (("phase_response", 4), ("amplitude_modulation", 2)):
        model = model.having(absent(known[name], captures.bench, order))
    model = fit(model, model.names, batches, 30).model
    errors = evaluate_captures(captures, roles.held_out, model)
    assert errors.excess < 1e-3
    with open_pool(1) as pool:
        found = fewer_from_another_start(roles, model, errors, Thresholds(), 0.3, pool)
    if not goes:
        assert found is None or found[0] != "amplitude_modulation"
        return
    assert found is not None and found[0] == "amplitude_modulation"
    assert found[1].names == ("polarisation_leak", "phase_response")
    assert found[2].excess < errors.excess
    assert float(found[1].instance("polarisation_leak").values["gain"]) < 0.5
