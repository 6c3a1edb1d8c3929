"""An effect that only looked right is exchanged for the right one, and the right one is not exchanged."""

from __future__ import annotations

import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.exchange import exchanged
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.model import Model, absent


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    folder = tmp_path_factory.mktemp("exchange")
    acquire_from(str(bench_file(folder, 'kind = "phase_response"')), folder / "captures", patterns=6)
    return read_captures(folder / "captures")


@pytest.mark.parametrize(
    ("present", "rival", "expected"),
    [
        ("zero_order", "phase_response", ("zero_order", "phase_response")),
        ("phase_response", "zero_order", None),
    ],
)
def test_held_out_captures_decide(
    present: str, rival: str, expected: tuple[str, str] | None, captures: CaptureSet
) -> None:
    roles = capture_roles(captures)
    batches = load(captures, roles.fitted)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    model, other = (
        fit(ideal.having(absent(catalogue()[name], captures.bench)), [name], batches).model
        for name in (present, rival)
    )
    errors = evaluate_captures(captures, roles.held_out, model)
    with open_pool(1) as pool:
        found = exchanged(roles, model, errors, {present: {rival: other.instance(rival)}}, pool)
        assert exchanged(roles, model, errors, {rival: {present: model.instance(present)}}, pool) is None
    assert (None if found is None else found[:2]) == expected
    if found is not None:
        assert found[2].names == (rival,) and found[3].excess < 0.5 * errors.excess
