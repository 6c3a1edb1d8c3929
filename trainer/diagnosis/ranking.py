"""Candidates fitted to the captures, and ranked by the held-out excess that each removes."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from runtime.excess import PredictionErrors, RemovedExcess, removed_excess
from runtime.program.progress import Progress
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.candidate_fits import (
    CandidateFit,
    try_effect,
    try_further,
    try_on_few,
    try_together,
    try_together_on_few,
    try_with_present,
)
from trainer.diagnosis.screen import ScreenResult
from trainer.diagnosis.screening import screened_whole
from trainer.diagnosis.telling import telling_captures
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.definition import Effect
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.gauss_newton import FitResult
from trainer.fitting.pixel_values import is_by_pixel
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.model import Model
from trainer.model.parameters import json_values

# A number for each pixel takes up a little of whatever stays in its place: share of the excess that it must remove.
PIXEL_SHARE = 0.01
# A candidate is near the best where it leaves at most NEAR times as much on few captures, and removes half as much; or,
# where its order can be raised, removes at least RAISED of what the best does. All are near where the best leaves more
# than LITTLE of the excess.
NEAR, RAISED, LITTLE = 2.0, 0.3, 0.9
# Of what the better of two candidates removes: by so much less removes one that is like it, and a plainer one.
ALIKE, PLAINER = 0.5, 0.1


@dataclass(frozen=True)
class RankedEffect:
    """A candidate in the ranking.

    Attributes
    ----------
    model : Model
        The diagnosed model with the candidate fitted in it.
    held_out : PredictionErrors
        Errors of `model` on the held-out captures.
    removed : RemovedExcess
        Held-out excess that the candidate removes.
    worth_adding : bool
        The removal is real, and it matters.
    indistinguishable_from : tuple of str
        Candidates that these captures cannot tell it from.
    together : FitResult or None
        Of `model`, where all of its effects were fitted together.
    """

    effect: Effect
    model: Model
    held_out: PredictionErrors
    removed: RemovedExcess
    worth_adding: bool
    indistinguishable_from: tuple[str, ...] = ()
    together: FitResult | None = None

    def as_json(self) -> dict[str, Any]:
        """A row of the key `ranking` of `diagnose --json`.

        Keys `effect`, `stage`, `excess_after`, `excess_removed`, `ci95`, `worth_adding`, `parameters` and
        `indistinguishable_from`.
        """
        low, high = self.removed.interval()
        return {
            "effect": self.effect.name,
            "stage": self.effect.stage,
            "excess_after": self.held_out.excess,
            "excess_removed": self.removed.value,
            "ci95": [low, high],
            "worth_adding": self.worth_adding,
            "parameters": json_values(self.model.instance(self.effect.name), self.model.bench),
            "indistinguishable_from": list(self.indistinguishable_from),
        }


def try_all(
    roles: CaptureRoles,
    model: Model,
    screened: Sequence[ScreenResult],
    pool: Pool,
    report: Progress,
    start: float,
    end: float,
) -> list[CandidateFit]:
    """Fit candidates at their lowest order.

    Parameters
    ----------
    report : callable
        Called with the share of the whole diagnosis that is done, and what is being done.
    start, end : float
        Shares of the diagnosis at which these fits begin and end.
    """
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    # The longest first, so that no process is left with one of them at the end.
    screened = sorted(screened_whole(roles, model, screened, pool), key=lambda s: not s.start.effect.rugged)

    def fitted(count: int) -> None:
        report(start + (end - start) * count / max(1, len(screened)), "fitting candidates")

    tasks = [(roles.folder, ids, held, model, s.start, False) for s in screened]
    return pool.map(try_effect, tasks, fitted)


def try_near(
    roles: CaptureRoles,
    model: Model,
    screened: Sequence[ScreenResult],
    others: Sequence[CandidateFit],
    least: float,
    pool: Pool,
    report: Progress,
    start: float,
    end: float,
    shown: float = -math.inf,
) -> list[CandidateFit]:
    """Fit candidates to few captures, and those that come near the best there to all.

    A candidate leaves no less on all captures than on few, where its numbers are free to suit these alone. So one that
    is far from the best there cannot be taken for it.

    Parameters
    ----------
    others : sequence of CandidateFit
        Candidates that are fitted already, to compare with.
    least : float
        Excess that makes no difference.
    report, start, end
        As for `try_all`.
    shown : float
        Excess that a candidate must remove on few captures to be fitted to all; -inf: any, and one alone is fitted to
        all at once.

    Returns
    -------
    list of CandidateFit
        Of those that come near.
    """
    if not screened:
        return []
    if len(screened) + len(others) < 2 and not math.isfinite(shown):
        return try_all(roles, model, screened, pool, report, start, end)
    telling = telling_captures(roles.captures, roles.fitted, model)
    few = ids_of(telling)
    screened = sorted(screened_whole(roles, model, screened, pool), key=lambda s: not s.start.effect.rugged)
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    before, *compared = (
        evaluate_captures(roles.captures, telling, one).excess for one in (model, *(f.model for f in others))
    )
    surely_near = min(least, before / 2)  # whatever others leave

    def most_near(left: float, screened: ScreenResult, raising: bool) -> float:
        """Excess on few captures up to which a candidate is near the best, which leaves `left` there."""
        if before - left < (1 - LITTLE) * abs(before):
            return math.inf
        return _near(left, before, least, raising and len(screened.start.effect.orders) > 1)

    # The best of all leaves no more than the best of the others.
    most = [min(most_near(min(compared, default=math.inf), s, True), before - shown) for s in screened]
    tasks = [
        (roles.folder, few, ids, held, model, s.start, surely_near, of_use)
        for s, of_use in zip(screened, most, strict=True)
    ]
    share = (end - start) / max(1, len(tasks))
    fits = pool.map(try_on_few, tasks, lambda n: report(start + n * share, "fitting candidates"))
    left = min(compared + [excess for _, excess, _ in fits])

    def near(raising: bool) -> list[str]:
        return [
            s.effect
            for (_, excess, _), s in zip(fits, screened, strict=True)
            if before - excess > shown and excess <= most_near(left, s, raising)
        ]

    def to_all(names: Collection[str]) -> list[CandidateFit]:
        chosen = [(fit, s) for fit, s in zip(fits, screened, strict=True) if s.effect in names]
        rest = [(fitted, s.effect) for (fitted, _, further), s in chosen if further is None]
        return [further for (*_, further), _ in chosen if further] + try_further_all(roles, rest, False, pool)

    found = to_all(near(raising=left > surely_near))
    if left <= surely_near < min((f.held_out.excess for f in (*others, *found)), default=math.inf):
        found += to_all(set(near(raising=True)) - {f.effect for f in found})
    return found


def _near(left: float, before: float, least: float, can_be_raised: bool) -> float:
    """Excess on few captures up to which a candidate is near the best, which leaves `left` there.

    Excess is negative where a number for each pixel has been fitted to these very captures.
    """
    if can_be_raised:
        return before - RAISED * (before - left)
    return min(NEAR * max(left, 0.0) + least, (before + left) / 2)


def try_further_all(
    roles: CaptureRoles, fitted: Sequence[tuple[Model, str]], raising: bool, pool: Pool
) -> list[CandidateFit]:
    """Go on with fits of one effect in each model, and raise its order as far as that helps if that is asked for."""
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    return pool.map(try_further, [(roles.folder, ids, held, model, name, raising) for model, name in fitted])


def raise_orders(
    roles: CaptureRoles, before: PredictionErrors, fits: Sequence[CandidateFit], pool: Pool
) -> list[CandidateFit]:
    """Raise the order of the fitted candidates that do about as well as the best.

    Parameters
    ----------
    before : PredictionErrors
        Held-out errors without any of the candidates.
    """
    if not fits:
        return []
    least, most = min(f.held_out.excess for f in fits), before.excess
    again = [
        (f.model, f.effect)
        for f in fits
        if len(f.model.instance(f.effect).effect.orders) > 1
        and most - f.held_out.excess > RAISED * (most - least)
    ]
    better = {f.effect: f for f in try_further_all(roles, again, True, pool)}
    return [better.get(f.effect, f) for f in fits]


def fit_with_present(
    roles: CaptureRoles, model: Model, screened: Sequence[ScreenResult], least: float, pool: Pool
) -> list[CandidateFit]:
    """Fit candidates at their lowest order, each together with the effects that are present.

    Several are fitted to few captures first, where a fit has more, and those that come near the best there to all.

    Parameters
    ----------
    least : float
        Excess that makes no difference.
    """
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    screened = screened_whole(roles, model, screened, pool)
    few = ids_of(telling_captures(roles.captures, roles.fitted, model)) if len(screened) > 1 else ids
    begun: list[tuple[ScreenResult, Model | None]] = [(s, None) for s in screened]
    if len(few) < len(ids):
        on_few = pool.map(try_together_on_few, [(roles.folder, few, model, s.start) for s in screened])
        most = NEAR * min(excess for _, excess in on_few) + least
        begun = [(s, there) for s, (there, excess) in zip(screened, on_few, strict=True) if excess <= most]
    return pool.map_here_if_one(
        try_with_present, [(roles.folder, ids, held, model, s.start, there) for s, there in begun]
    )


def try_together_with_present(
    roles: CaptureRoles, with_candidate: Mapping[str, Model], pool: Pool
) -> list[CandidateFit]:
    """Fit candidates, each together with the effects that are present, and raise orders.

    An effect that was added alone may have taken up a part of one that is still missing, and then hides it.

    Parameters
    ----------
    with_candidate : mapping of str to Model
        By candidate: the model with it. By an empty name: the present effects alone.
    """
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    tasks = [(roles.folder, ids, held, one, name) for name, one in with_candidate.items()]
    return pool.map(try_together, tasks)


def rank(
    before: PredictionErrors,
    fits: Sequence[CandidateFit],
    known: Catalogue,
    thresholds: Thresholds,
    ideal_excess: float,
    candidates: int,
) -> list[RankedEffect]:
    """Candidates by excess removed, each with those that the captures cannot tell it from.

    Parameters
    ----------
    before : PredictionErrors
        Held-out errors without any of the candidates.
    ideal_excess : float
        Held-out excess of the bench file's own model.
    candidates : int
        How many were screened, which the test of each is corrected for.
    """

    def is_worth_adding(one: CandidateFit) -> bool:
        removed = removed_excess(before, one.held_out)
        enough = not is_by_pixel(known[one.effect]) or removed.value > PIXEL_SHARE * before.excess
        return enough and thresholds.worth_adding(removed, ideal_excess, candidates)

    ordered = sorted(fits, key=lambda f: f.held_out.excess)
    worth = {f.effect: is_worth_adding(f) for f in ordered}
    for one in ordered[1:]:  # of two that the captures cannot tell apart, the plainer comes first
        if worth[one.effect] >= worth[ordered[0].effect] and _is_plainer(one, ordered[0], before, thresholds):
            ordered.remove(one)
            ordered.insert(0, one)
            break
    ranked = []
    for one in ordered:
        removed, worth_adding = removed_excess(before, one.held_out), worth[one.effect]
        alike = tuple(
            other.effect
            for other in ordered
            if other is not one
            and worth_adding
            and _inseparable(one, other, before, thresholds, ideal_excess, candidates)
        )
        ranked.append(
            RankedEffect(
                known[one.effect], one.model, one.held_out, removed, worth_adding, alike, one.together
            )
        )
    return ranked


def _is_plainer(
    one: CandidateFit, best: CandidateFit, before: PredictionErrors, thresholds: Thresholds
) -> bool:
    """Whether a candidate says as much as the best, and is plainer."""
    if not _alike(one, best, before, thresholds, PLAINER):
        return False
    return one.model.instance(one.effect).is_plainer_than(best.model.instance(best.effect))


def _inseparable(
    one: CandidateFit,
    other: CandidateFit,
    before: PredictionErrors,
    thresholds: Thresholds,
    ideal_excess: float,
    candidates: int,
) -> bool:
    if not thresholds.worth_adding(removed_excess(before, other.held_out), ideal_excess, candidates):
        return False
    worse, better = (one, other) if one.held_out.excess > other.held_out.excess else (other, one)
    return _alike(worse, better, before, thresholds, ALIKE)


def _alike(
    worse: CandidateFit,
    better: CandidateFit,
    before: PredictionErrors,
    thresholds: Thresholds,
    less: float,
) -> bool:
    """Whether captures cannot tell two apart, and the worse removes less by no more than this share of the better."""
    left = better.held_out.excess
    difference = removed_excess(worse.held_out, better.held_out)
    return thresholds.inseparable(difference, left, less * (before.excess - left))
