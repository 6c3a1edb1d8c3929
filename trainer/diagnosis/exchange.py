"""Effects of a model exchanged for one that could have been added in place of one of them.

An effect that was added early may have stood for the right one: the two looked alike while others were missing. A later
one may then have been added for what the first does not do as the right one does, and the right one stands for both.
"""

from __future__ import annotations

from collections.abc import Mapping

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.addition import all_raised, all_refitted
from trainer.diagnosis.candidate_fits import try_together_on_few
from trainer.diagnosis.ranking import telling_captures
from trainer.diagnosis.verdict import Thresholds
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.model import EffectInstance, Model

# Of the excess: what an exchange leaves at most. While others are missing, the wrong one may suit the captures a little
# better.
CLEARLY = 0.5

Rivals = Mapping[
    str, Mapping[str, EffectInstance]
]  # by effect of the model, and by its rival: that one's fit


def exchanged(
    roles: CaptureRoles, model: Model, errors: PredictionErrors, rivals: Rivals, pool: Pool
) -> tuple[str, str, Model, PredictionErrors] | None:
    """The model with one effect exchanged for a rival, where held-out captures clearly say so.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.
    rivals : mapping
        A rival's fit is the one of when the effect was added, in its place.

    Returns
    -------
    (str, str, Model, PredictionErrors) or None
        What was taken out, what was put in its place, and the model, everything refitted.
    """
    pairs = [
        (old, new, fitted)
        for old, others in rivals.items()
        for new, fitted in others.items()
        if old in model.names and new not in model.names
    ]
    if not pairs:
        return None
    # What a model cannot explain of few captures, with its numbers free to suit these alone, it cannot explain of all.
    few = telling_captures(roles, model)
    left = evaluate_captures(roles.captures, few, model).excess
    ids = ids_of(few)
    on_few = pool.map_here_if_one(
        try_together_on_few, [(roles.folder, ids, model.without(old), fitted) for old, _, fitted in pairs]
    )
    pairs = [pair for pair, excess in zip(pairs, on_few, strict=True) if excess < CLEARLY * left]
    tasks = [(roles.folder, roles.ids, model.without(old), fitted) for old, _, fitted in pairs]
    found = list(zip(pairs, pool.map_here_if_one(all_refitted, tasks), strict=True))
    if not found:
        return None
    (old, new, _), (together, after) = min(found, key=lambda one: one[1][1].excess)
    if after.excess > CLEARLY * errors.excess:  # before orders are raised, which is most of the work
        return None
    other, after = all_raised(roles.folder, roles.ids, together, after)
    if after.excess > CLEARLY * errors.excess or removed_excess(errors, after).interval()[0] <= 0:
        return None
    return old, new, other, after


def one_for_two(
    roles: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    rivals: Rivals,
    thresholds: Thresholds,
    ideal_excess: float,
    pool: Pool,
) -> tuple[str, str, str, Model, PredictionErrors] | None:
    """The model with one effect in place of two of its stage, a rival of one of them, where it does as well.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.
    rivals : mapping
        As of `exchanged`.

    Returns
    -------
    (str, str, str, Model, PredictionErrors) or None
        The rival's effect, the two, and the model with it, everything refitted.
    """
    stages = {name: model.instance(name).effect.stage for name in model.names}
    triples = [
        (old, other, new, model.without(old).without(other), fitted)
        for old, others in rivals.items()
        for new, fitted in others.items()
        for other in model.names
        if old in stages and new not in stages and other != old
        if stages[other] == stages[old] == fitted.effect.stage
    ]
    if not triples:
        return None
    few = telling_captures(roles, model)
    enough = evaluate_captures(roles.captures, few, model).excess + thresholds.least(ideal_excess)
    ids = ids_of(few)
    on_few = pool.map_here_if_one(try_together_on_few, [(roles.folder, ids, *one[3:]) for one in triples])
    triples = [one for one, excess in zip(triples, on_few, strict=True) if excess < enough]
    tasks = [(roles.folder, roles.ids, *one[3:]) for one in triples]
    found = list(zip(triples, pool.map_here_if_one(all_refitted, tasks), strict=True))
    if not found:
        return None
    (old, other, new, *_), (together, after) = min(found, key=lambda one: one[1][1].excess)
    if thresholds.worth_adding(removed_excess(after, errors), ideal_excess, 1):
        return None
    return new, old, other, together.model, after
