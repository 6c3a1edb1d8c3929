"""Which of two candidates that look alike comes first, and which is fitted beside the best one."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.excess import PredictionErrors
from trainer.captures.bench_file import Bench, Camera, Channel, Iris, Panel
from trainer.diagnosis.candidate_fits import CandidateFit
from trainer.diagnosis.explanation import _rival
from trainer.diagnosis.ranking import rank
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import catalogue
from trainer.model.model import Model, absent


@dataclass
class Candidate:
    """What the ranking says of an effect."""

    effect: Any
    removed: Any
    worth_adding: bool = True


def found(ranking: dict[str, float], screened: list[str], worthless: tuple[str, ...] = ()) -> Any:
    """A diagnosis: excess that each fitted candidate removes, best first, and the screen's order."""
    ranked = [
        Candidate(SimpleNamespace(name=n), SimpleNamespace(value=v), n not in worthless)
        for n, v in ranking.items()
    ]
    return SimpleNamespace(ranking=ranked, screened=[SimpleNamespace(effect=n) for n in screened])


@pytest.mark.parametrize(
    ("ranking", "screened", "worthless", "rival"),
    [
        # A present effect took up most of the right one: alone it removes little, the screen expects most of it.
        ({"modulation": 0.028, "leak": 0.011}, ["leak", "modulation"], (), "leak"),
        ({"modulation": 0.028, "leak": 0.021}, ["modulation", "leak"], (), "leak"),  # near
        ({"modulation": 0.028, "leak": 0.011}, ["modulation", "leak"], (), None),  # far behind in both
        ({"modulation": 0.028, "leak": 0.011}, ["leak", "modulation"], ("leak",), None),
        ({"modulation": 0.028}, ["modulation"], (), None),
    ],
)
def test_the_rival_is_what_the_screen_expects_most_of_or_what_is_near(
    ranking: dict[str, float], screened: list[str], worthless: tuple[str, ...], rival: str | None
) -> None:
    one = _rival(found(ranking, screened, worthless))
    assert (one and one.effect.name) == rival


def errors(excess: float) -> PredictionErrors:
    """Of ten captures that are all alike."""
    noise = np.full((10, 4), 0.01)
    return PredictionErrors(
        tuple(str(k) for k in range(10)), noise + excess / 4, noise, np.ones(10), np.full(10, 100.0)
    )


@pytest.mark.parametrize(
    ("leak", "first"),
    [
        (0.18, "phase_response"),  # three quarters of the other's excess is not enough to tell them apart
        (0.05, "polarisation_leak"),
    ],
)
def test_of_two_that_look_alike_the_one_that_few_benches_have_comes_second(leak: float, first: str) -> None:
    known, camera = catalogue(), Camera(8, 8, 8.0, True, 12, 64.0, 10500.0, 5.0)
    bench = Bench("ideal", Panel(8, 8, 8.0), (Channel("green", 520.0),), 30.0, Iris(), camera)
    fits = [
        CandidateFit(name, Model(bench).having(absent(known[name], bench)), errors(excess))
        for name, excess in (("polarisation_leak", leak), ("phase_response", 0.2))
    ]
    ranking = rank(errors(0.5), fits, known, Thresholds(), 0.5, len(known))
    assert ranking[0].effect.name == first
