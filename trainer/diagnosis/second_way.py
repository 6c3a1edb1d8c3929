"""Where an explanation could have gone another way: an effect was added that a rival came near to.

Two wrong effects together can leave so little that nothing more is missing. No exchange of one of them leads out of
that: the right one in its place needs others beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from runtime.excess import PredictionErrors, removed_excess
from trainer.diagnosis.ranking import RankedEffect
from trainer.model.model import Model

NEAR = 3.0  # times the excess that the best candidate left: a rival that left so little could have been added, too


@dataclass(frozen=True)
class Fork:
    """A step at which an effect was added, and others could have been.

    Attributes
    ----------
    step, diagnosis : int
        How many steps and diagnoses there were before.
    before : Model
    added : str
    rivals : tuple of str
        Effects that came near.
    """

    step: int
    diagnosis: int
    before: Model
    added: str
    rivals: tuple[str, ...]


def fork_at(
    step: int, diagnosis: int, before: Model, added: RankedEffect, ranking: Sequence[RankedEffect]
) -> Fork:
    """The fork at a step, with the rivals that the ranking has."""
    most = NEAR * added.held_out.excess
    rivals = (
        r.effect.name
        for r in ranking
        if r.worth_adding and r.effect.name != added.effect.name and r.held_out.excess <= most
    )
    return Fork(step, diagnosis, before, added.effect.name, tuple(rivals))


def doubtful(forks: Sequence[Fork], model: Model) -> Fork | None:
    """The first fork whose effect is in the model and one of whose rivals is not."""
    names = model.names
    return next((f for f in forks if f.added in names and not set(f.rivals) <= set(names)), None)


def is_hopeless(
    model: Model, errors: PredictionErrors, to_beat: Model, errors_to_beat: PredictionErrors
) -> bool:
    """Whether a model has as many effects already as the one that it should be better than, and leaves more."""
    return len(model.names) >= len(to_beat.names) and errors.excess > errors_to_beat.excess


def is_better(
    model: Model, errors: PredictionErrors, other: Model, other_errors: PredictionErrors, confidence: float
) -> bool:
    """Whether held-out captures prefer another model, which needs no more effects."""
    gained = removed_excess(errors, other_errors)
    return len(other.names) <= len(model.names) and gained.interval(confidence)[0] > 0
