"""Effects of a model exchanged for one that could have been added in place of one of them.

An effect that was added early may have stood for the right one: the two looked alike while others were missing. A later
one may then have been added for what the first does not do as the right one does, and the right one stands for both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.addition import all_raised, all_refitted
from trainer.diagnosis.candidate_fits import try_together_on_few
from trainer.diagnosis.telling import telling_captures
from trainer.diagnosis.verdict import Thresholds
from trainer.fitting.gauss_newton import FitResult
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
    pairs = _pairs(model, rivals)
    trials = [(model.without(old), fitted) for old, _, fitted in pairs]
    found = _promising(roles, model, trials, lambda left: CLEARLY * left, pool)
    if not found:
        return None
    which, together, after = found[0]
    old, new, _ = pairs[which]
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
    trials = [(base, fitted) for *_, base, fitted in triples]
    found = _promising(roles, model, trials, lambda left: left + thresholds.least(ideal_excess), pool)
    if not found:
        return None
    which, together, after = found[0]
    old, other, new, *_ = triples[which]
    if thresholds.worth_adding(removed_excess(after, errors), ideal_excess, 1):
        return None
    return new, old, other, together.model, after


def preferred(
    roles: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    rivals: Rivals,
    thresholds: Thresholds,
    ideal_excess: float,
    pool: Pool,
) -> tuple[str, str, Model, PredictionErrors] | None:
    """The model with one effect exchanged for a rival that captures prefer now that nothing else is missing.

    A plainer rival is preferred unless it does worse, even with its orders raised. A less plain one is preferred only
    where it is worth it; where too little is left for that, it is not tried.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.
    rivals : mapping
        By effect, what may do as well in its place: where its fit begins.

    Returns
    -------
    (str, str, Model, PredictionErrors) or None
        As of `exchanged`.
    """
    enough = thresholds.may_be_worth_adding(errors.excess, ideal_excess)
    pairs = [
        (old, new, fitted)
        for old, new, fitted in _pairs(model, rivals)
        if enough or not model.instance(old).is_plainer_than(fitted)
    ]
    trials = [(model.without(old), fitted) for old, _, fitted in pairs]
    found = _promising(roles, model, trials, lambda left: left + thresholds.least(ideal_excess), pool)

    def does_worse(after: PredictionErrors) -> bool:
        return removed_excess(after, errors).interval(1 - thresholds.level)[0] > 0

    for which, together, after in found:
        old, new, _ = pairs[which]
        present, other = model.instance(old), together.model
        gained = removed_excess(errors, after)
        if present.is_plainer_than(other.instance(new)):
            prefers = thresholds.worth_adding(gained, ideal_excess, len(pairs))
        elif other.instance(new).is_plainer_than(present):
            if does_worse(after):  # it may lack no more than an order
                other, after = all_raised(roles.folder, roles.ids, together, after)
            prefers = not does_worse(after) and other.instance(new).is_plainer_than(present)
        else:
            prefers = gained.interval(1 - thresholds.level, len(pairs))[0] > 0
        if prefers:
            return old, new, other, after
    return None


def _pairs(model: Model, rivals: Rivals) -> list[tuple[str, str, EffectInstance]]:
    """Effects of the model with their rivals that are not in it: the two names, and the rival's fit."""
    return [
        (old, new, fitted)
        for old, others in rivals.items()
        for new, fitted in others.items()
        if old in model.names and new not in model.names
    ]


def _promising(
    roles: CaptureRoles,
    model: Model,
    trials: Sequence[tuple[Model, EffectInstance]],
    most: Callable[[float], float],
    pool: Pool,
) -> list[tuple[int, FitResult, PredictionErrors]]:
    """The trials, each a model and an effect added to it, that leave little enough on few captures.

    Parameters
    ----------
    most : callable
        Excess on few captures above which a trial is not fitted to all, from the excess of `model` there.

    Returns
    -------
    list of (int, FitResult, PredictionErrors)
        Which one, its fit with everything free, and its errors on the held-out captures; those that leave least first.
    """
    if not trials:
        return []
    # What a model cannot explain of few captures, with its numbers free to suit these alone, it cannot explain of all.
    few = telling_captures(roles.captures, roles.fitted, model)
    enough = most(evaluate_captures(roles.captures, few, model).excess)
    ids = ids_of(few)
    on_few = pool.map_here_if_one(
        try_together_on_few, [(roles.folder, ids, *trial, enough) for trial in trials]
    )
    promising = [k for k, (_, excess) in enumerate(on_few) if excess < enough]
    # A rival's fit is of when it was added; what few captures made of all effects is often nearer.
    tasks = [(roles.folder, roles.ids, trials[k][0].having(trials[k][1]), on_few[k][0]) for k in promising]
    fits = pool.map_here_if_one(all_refitted, tasks)
    found = [(k, together, after) for k, (together, after) in zip(promising, fits, strict=True)]
    return sorted(found, key=lambda one: one[2].excess)
