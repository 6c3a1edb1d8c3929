"""What an explanation says beside its steps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from trainer.diagnosis.explanation import Explanation


def diagnosis_of(best: str | None, *suggested: str) -> Any:
    ranked = None if best is None else SimpleNamespace(effect=SimpleNamespace(name=best))
    return SimpleNamespace(best=ranked, suggested_captures=suggested)


def test_captures_that_would_tell_of_an_effect_that_went_again_are_not_suggested() -> None:
    last = diagnosis_of(None, "another plane")
    diagnoses = (
        diagnosis_of("distance", "the blue laser", "another plane"),
        diagnosis_of("source_lines", "64 mm"),
        last,
    )
    model: Any = SimpleNamespace(names=("distance",))
    found = Explanation((), model, last, diagnoses)
    assert found.suggested_captures == ["the blue laser", "another plane"]
