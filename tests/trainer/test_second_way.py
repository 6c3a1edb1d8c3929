"""The second way to an explanation, where two wrong effects would count as complete."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from runtime.excess import PredictionErrors
from tests.trainer.hidden import bench_text
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import read_captures
from trainer.diagnosis.explanation import explain
from trainer.diagnosis.second_way import Fork, doubtful, fork_at, is_better, is_hopeless
from trainer.effects.effect_catalogue import catalogue
from trainer.effects.testing import small_bench
from trainer.fitting.pool import open_pool
from trainer.model.model import Model, absent

KNOWN = catalogue()
HIDDEN = (
    'kind = "zero_order"\nfill_factor = 0.9355\nsurface_amplitude = 0.0967',
    'kind = "amplitude_modulation"\nfall = 0.1422',
    'kind = "spatial_coherence"\nradius_mrad = 0.332',
)


def model_of(*names: str) -> Model:
    model = Model(small_bench())
    for name in names:
        model = model.having(absent(KNOWN[name], model.bench))
    return model


def errors(excess: float, spread: float = 0.0) -> PredictionErrors:
    """Of ten captures; `spread` of the excess from one to another."""
    noise = np.full((10, 4), 0.01)
    each = excess / 4 + spread * np.random.default_rng(0).normal(size=(10, 1)) / 4
    return PredictionErrors(
        tuple(str(k) for k in range(10)), noise + each, noise, np.ones(10), np.full(10, 100.0)
    )


def ranked(name: str, excess: float, worth_adding: bool = True) -> Any:
    effect, left = SimpleNamespace(name=name), SimpleNamespace(excess=excess)
    return SimpleNamespace(effect=effect, held_out=left, worth_adding=worth_adding)


def test_rivals_that_came_near_open_another_way() -> None:
    best = ranked("polarisation_leak", 0.0017)
    ranking = [
        best,
        ranked("zero_order", 0.0041),
        ranked("phase_response", 0.0018, worth_adding=False),
        ranked("ghost", 0.1),
    ]
    fork = fork_at(1, 0, model_of(), best, ranking)
    assert (fork.added, fork.rivals) == ("polarisation_leak", ("zero_order",))


def test_the_first_effect_whose_rival_is_not_there_is_in_doubt() -> None:
    forks = [
        Fork(1, 0, model_of(), "stray_light", ()),
        Fork(2, 1, model_of(), "zero_order", ("ghost",)),
        Fork(3, 2, model_of(), "phase_response", ("polarisation_leak",)),
    ]
    all_three = model_of("stray_light", "zero_order", "phase_response")
    assert doubtful(forks, all_three) == forks[1]
    assert doubtful(forks, all_three.without("zero_order")) == forks[2]
    assert doubtful(forks[:2], all_three.having(absent(KNOWN["ghost"], all_three.bench))) is None


def test_another_model_has_to_be_better_and_no_longer() -> None:
    one, two = model_of("zero_order"), model_of("zero_order", "ghost")
    assert is_better(two, errors(0.0004), one, errors(0.0003), 0.95)
    assert not is_better(one, errors(0.0004), two, errors(0.0003), 0.95)
    assert not is_better(one, errors(0.0003), one, errors(0.0003), 0.95)
    assert not is_better(one, errors(0.0004, spread=0.01), one, errors(0.0003), 0.95)


def test_a_way_that_needs_as_many_effects_and_leaves_more_is_hopeless() -> None:
    one, two = model_of("zero_order"), model_of("zero_order", "ghost")
    assert is_hopeless(two, errors(0.0005), two, errors(0.0004))
    assert not is_hopeless(one, errors(0.0005), two, errors(0.0004)), "one more may do better"
    assert not is_hopeless(two, errors(0.0003), two, errors(0.0004))


def test_two_effects_that_stand_for_others_give_way(tmp_path: Path) -> None:
    """A polarisation leak with a bent response does nearly what a zero order does on a panel that absorbs."""
    text = bench_text(128, 96, 1.74845, fill_factor=0.93)
    for name, value in (("pitch_um", 3.74), ("pixel_um", 3.74), ("wavelength_nm", 780)):
        text = text.replace(f"{name} = {520 if name == 'wavelength_nm' else 8}", f"{name} = {value}")
    bench = tmp_path / "bench.toml"
    bench.write_text(text + "".join(f"\n[[defect]]\n{one}\n" for one in HIDDEN))
    acquire_from(str(bench), tmp_path / "captures", patterns=14, seed=41)
    captures = read_captures(tmp_path / "captures")
    with open_pool(1) as pool:
        found = explain(captures, Model(captures.bench), KNOWN, pool)
    assert {"zero_order", "amplitude_modulation"} <= set(found.model.names)
    assert "polarisation_leak" not in found.model.names
    assert [s.held_out.excess for s in found.steps] == [h["excess"] for h in found.model.history]
