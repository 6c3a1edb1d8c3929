"""Which candidate is added: the best one, or a close rival that does better once all is fitted together."""

from __future__ import annotations

import math

from runtime.excess import PredictionErrors, RemovedExcess, removed_excess
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.addition import all_raised, all_refitted
from trainer.diagnosis.diagnosis import Diagnosis
from trainer.diagnosis.exchange import CLEARLY
from trainer.diagnosis.ranking import RankedEffect
from trainer.diagnosis.screen import ScreenResult
from trainer.fitting.pool import Pool
from trainer.model.model import Model

NEAR = 0.7  # of the excess that the best candidate removes: a candidate that removes so much is near
ABOUT = 1.5  # times the excess that another leaves, or is expected to: about as much


def chosen_addition(
    roles: CaptureRoles, found: Diagnosis, pool: Pool
) -> tuple[RankedEffect, Model, PredictionErrors]:
    """The effect to add, the model with it, everything refitted, and that model's held-out errors.

    A candidate is ranked while present effects stay as they are, and these may have taken up a part of the right one.
    So its closest rival is fitted together with them, too, before the orders of the better one are raised. A rival that
    only the screen speaks for, and that leaves about as much, has its orders raised, too, and so has one that more
    benches have than the best: the best is added then only where it leaves at most half as much.
    """
    best = found.ranking[0]
    rival = _rival(found) if found.model.present or best.effect.rare else None
    ones = [best] if rival is None else [best, rival]
    tasks = [(roles.folder, roles.ids, one.model) for one in ones if one.together is None]
    refitted = iter(pool.map_here_if_one(all_refitted, tasks))
    fitted = [(one.together, one.held_out) if one.together else next(refitted) for one in ones]
    undecided = False
    if rival is not None:
        (_, left), (_, after) = fitted
        if best.effect.rare and not rival.effect.rare:
            undecided = True
        elif not rival.worth_adding:
            undecided = after.excess <= ABOUT * left.excess
        elif _better(after, left, clearly=rival.effect.rare):
            ones, fitted = ones[1:], fitted[1:]
        if not undecided:
            ones, fitted = ones[:1], fitted[:1]
    raised = pool.map_here_if_one(all_raised, [(roles.folder, roles.ids, *one) for one in fitted])
    which = 0
    if undecided:
        (_, left), (_, after) = raised
        if best.effect.rare:
            which = 0 if _better(left, after, clearly=True) else 1
        else:
            # One that only the screen speaks for may have numbers that suit a little of anything.
            which = 1 if _better(after, left, clearly=True) else 0
    return ones[which], *raised[which]


def _better(one: PredictionErrors, other: PredictionErrors, clearly: bool) -> bool:
    """Whether held-out captures prefer one of two models; clearly: whether it leaves at most half, too."""
    enough = not clearly or one.excess < CLEARLY * other.excess
    return enough and removed_excess(other, one).interval()[0] > 0


def _rival(found: Diagnosis) -> RankedEffect | None:
    """The candidate that may be right instead of the best one.

    It is the one that the screen, which lets present effects move, expects most of; or the next best, where it is near;
    or one of which the screen expects about as much, even if it got nowhere while present effects stayed as they were.
    The last is told from the best one only after orders are raised.
    """
    best, *others = worthwhile = [r for r in found.ranking if r.worth_adding]
    first = found.screened[0] if found.screened else None
    if first is None or first.effect == best.effect.name:
        near = next((r for r in others if r.removed.value > NEAR * best.removed.value), None)
    else:
        near = next((r for r in others if r.effect.name == first.effect), None)
    if near is not None or first is None or best.together is not None:
        return near
    names = [r.effect.name for r in worthwhile]
    about = (s for s in found.screened if s.after < ABOUT * first.after and s.effect not in names)
    return next((_unfitted(found, s) for s in about if not s.start.effect.rare), None)


def _unfitted(found: Diagnosis, expected: ScreenResult) -> RankedEffect:
    """A candidate as it starts, of which only the screen has said something."""
    start = expected.start
    unknown = RemovedExcess(0.0, math.inf)
    return RankedEffect(start.effect, found.model.having(start), found.held_out, unknown, False)
