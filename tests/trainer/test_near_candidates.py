"""Which candidates that were fitted to few captures are fitted to all."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from trainer.diagnosis import ranking
from trainer.diagnosis.ranking import try_near


def near(monkeypatch: pytest.MonkeyPatch, before: float, few: dict[str, float], *shown: float) -> set[str]:
    """The candidates that go on to all captures, of those that leave so much excess on few."""
    left = SimpleNamespace(excess=before)
    monkeypatch.setattr(ranking, "telling_captures", lambda *_: [])
    monkeypatch.setattr(ranking, "evaluate_captures", lambda *_: left)
    effect = SimpleNamespace(rugged=False, orders=(0,))
    screened: list[Any] = [
        SimpleNamespace(effect=name, whole=True, start=SimpleNamespace(effect=effect)) for name in few
    ]

    def fitted(task: Any, arguments: list[Any], progress: Any = None) -> list[Any]:
        if task is ranking.try_on_few:
            return [(None, few[s.effect], None) for s in screened]
        return [SimpleNamespace(effect=name, held_out=left) for *_, name, _ in arguments]

    roles: Any = SimpleNamespace(folder=None, fitted=(), held_out=(), captures=None)
    pool: Any = SimpleNamespace(map=fitted)
    found = try_near(roles, None, screened, [], 2e-4, pool, lambda *_: None, 0, 1, *shown)  # type: ignore[arg-type]
    return {one.effect for one in found}


def test_those_that_come_near_the_best_are_fitted_to_all(monkeypatch: pytest.MonkeyPatch) -> None:
    assert near(monkeypatch, 0.1, {"best": 0.01, "near": 0.019, "far": 0.03}) == {"best", "near"}


def test_where_none_gets_anywhere_all_are_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert near(monkeypatch, 0.1, {"one": 0.095, "other": 0.1}) == {"one", "other"}


@pytest.mark.parametrize("before", [3e-4, -1e-4, -3e-4])
def test_a_pattern_of_pixels_may_have_been_fitted_to_the_noise_of_these_captures(
    monkeypatch: pytest.MonkeyPatch, before: float
) -> None:
    """Then less than nothing is left, and the best is still as near as any."""
    few = {"best": -3.1e-4, "other": -3e-4}
    assert near(monkeypatch, before, few) == {"best", "other"}
    assert near(monkeypatch, before, {**few, "far": 1.0}) >= {"best", "other"}


@pytest.mark.parametrize("before", [4e-4, 6e-5])
def test_where_next_to_nothing_is_left_only_those_that_show_are_fitted_to_all(
    monkeypatch: pytest.MonkeyPatch, before: float
) -> None:
    """What few captures do not show cannot be worth adding, even where none gets anywhere or only one is asked."""
    few = {"shows": before - 6e-5, "does not": before - 4e-5}
    assert near(monkeypatch, before, few, 5e-5) == {"shows"}
    assert near(monkeypatch, before, {"does not": before}, 5e-5) == set()
    assert near(monkeypatch, before, {}, 5e-5) == set()
