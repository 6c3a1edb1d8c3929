"""An effect that ended in the wrong place is found by starting anew; one that is right comes back."""

from __future__ import annotations

import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.candidate_fits import CandidateFit, try_again
from trainer.diagnosis.explanation import explain
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import open_pool
from trainer.model.history import ANEW
from trainer.model.model import Model, instance_with

GAIN = 1.1


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
