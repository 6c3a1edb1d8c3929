"""Which candidate is fitted beside the best one, together with what a model has already."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from trainer.diagnosis.explanation import _rival


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
