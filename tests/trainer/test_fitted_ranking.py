"""Which candidate ranks first where present effects have taken up a part of the one that is missing."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.addition import add_from
from trainer.diagnosis.candidate_fits import CandidateFit, try_effect, try_on_few
from trainer.diagnosis.diagnosis import diagnose
from trainer.diagnosis.ranking import try_together_with_present
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.pool import open_pool
from trainer.model.model import Model, absent

HIDDEN = ("phase_response", "illumination", "zero_order")


def test_the_one_that_explains_the_rest_with_present_effects_free_ranks_first(tmp_path: Path) -> None:
    acquire_from(
        str(bench_file(tmp_path, *(f'kind = "{name}"' for name in HIDDEN))),
        tmp_path / "captures",
        patterns=6,
    )
    captures = read_captures(tmp_path / "captures")
    roles = capture_roles(captures)
    known = {name: catalogue()[name] for name in (*HIDDEN, "amplitude_modulation")}
    model = with_gains(captures, Model(captures.bench), roles.fitted)
    for name in HIDDEN[:2]:
        model = add_from(roles, model, absent(known[name], captures.bench))
    fitted, held = (tuple(c.capture for c in rows) for rows in (roles.fitted, roles.held_out))
    alone = {
        name: try_effect(captures.folder, fitted, held, model, absent(known[name], captures.bench), True)
        for name in ("amplitude_modulation", "zero_order")
    }
    assert alone["amplitude_modulation"].held_out.excess < 0.5 * alone["zero_order"].held_out.excess
    with open_pool(1) as pool:
        found = diagnose(captures, model, known, pool, thorough=False)
    assert found.best is not None and found.best.effect.name == "zero_order"
    assert found.best.held_out.excess < 0.02 * found.held_out.excess


def test_what_is_read_off_captures_is_asked_before_what_takes_a_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The screen expects nothing of a power that varies from capture to capture: it looks at one capture."""
    acquire_from(str(bench_file(tmp_path, 'kind = "laser_drift"')), tmp_path / "captures", patterns=6)
    captures = read_captures(tmp_path / "captures")
    names = ("iris", "laser_drift", "sensor_response", "temporal_coherence", "vibration")
    searched: list[str] = []

    def noted(*task: Any) -> Any:
        searched.append(task[5].effect.name)
        return try_on_few(*task)

    monkeypatch.setattr("trainer.diagnosis.ranking.try_on_few", noted)
    with open_pool(1) as pool:
        known = {name: catalogue()[name] for name in names}
        found = diagnose(captures, Model(captures.bench), known, pool, thorough=False)
    assert found.best is not None and found.best.effect.name == "laser_drift"
    assert not {"iris", "vibration"} & set(searched)


def test_what_was_fitted_together_is_not_fitted_again_from_where_it_leads_no_farther(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where nothing explains the rest: the screen's candidates are fitted with present effects, then the closest."""
    hidden = ('kind = "phase_response"', 'kind = "stripes"')
    acquire_from(str(bench_file(tmp_path, *hidden)), tmp_path / "captures", patterns=6)
    captures = read_captures(tmp_path / "captures")
    roles = capture_roles(captures)
    names = ("phase_response", "distance", "sensor_blur", "spatial_coherence")
    known = {name: catalogue()[name] for name in names}
    model = with_gains(captures, Model(captures.bench), roles.fitted)
    model = add_from(roles, model, absent(known["phase_response"], captures.bench))
    turns: list[list[CandidateFit]] = []

    def noted(*task: Any) -> list[CandidateFit]:
        turns.append(try_together_with_present(*task))
        return turns[-1]

    monkeypatch.setattr("trainer.diagnosis.fitted_ranking.try_together_with_present", noted)
    with open_pool(1) as pool:
        found = diagnose(captures, model, known, pool, thorough=False)
    first, second = ({f.effect: f.held_out.excess for f in turn} for turn in turns)
    assert set(first) == {"", *names[1:]}
    assert set(second) < set(names[1:])
    left = {r.effect.name: r.held_out.excess for r in found.ranking}
    assert left == {name: min(first[name], second.get(name, math.inf)) for name in names[1:]}
