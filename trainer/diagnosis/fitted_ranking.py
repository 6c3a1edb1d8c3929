"""Which candidates of a diagnosis are fitted, how far, and how they rank."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from runtime.excess import PredictionErrors
from runtime.program.progress import Progress
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.candidate_fits import CandidateFit
from trainer.diagnosis.exchange import CLEARLY
from trainer.diagnosis.ranking import (
    NEAR,
    RankedEffect,
    fit_with_present,
    raise_orders,
    rank,
    try_all,
    try_near,
    try_together_with_present,
)
from trainer.diagnosis.screen import ScreenResult
from trainer.diagnosis.screening import screened_whole
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.pool import Pool
from trainer.model.model import Model

FITTED_FIRST = 5  # candidates fitted after the screen; all of them when none of these explains anything
# Where it is not thorough, no other candidate is asked for where one leaves at most this share of the excess: either
# nothing that is worth adding, or enough for another look at all of them.
SETTLES = 0.1
SURELY_SETTLES = 0.002  # share of the excess for what lies between the two
RIVALS = 0.5  # at first those are fitted that the screen expects to remove so much of what the best one does
# Of the least that is worth adding: a candidate of which few captures show less than this share, where the model is
# complete and all that is left is not much more than that least, is not fitted to all.
SHOWS = 0.25
# Candidates fitted with present effects free where none explains anything alone: those that the screen expects most of,
# and, unless one of them clearly explains what is left, those that came closest alone.
FITTED_TOGETHER = 3
TOGETHER = "fitting candidates and present effects together"


def fitted_ranking(
    roles: CaptureRoles,
    model: Model,
    before: PredictionErrors,
    order: Sequence[ScreenResult],
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds,
    ideal_excess: float,
    thorough: bool,
    report: Progress,
) -> tuple[list[RankedEffect], list[CandidateFit]]:
    """Fit the candidates that may explain the most, and rank them.

    Parameters
    ----------
    before : PredictionErrors
        Held-out errors of `model`.
    order : sequence of ScreenResult
        All candidates, the one that the screen expects most of first.
    ideal_excess : float
        Held-out excess of the bench file's own model.
    thorough : bool
        False: candidates of which the screen says little are not fitted, and no orders are raised, where one candidate
        leaves next to nothing.
    report : callable
        Called with the share of the whole diagnosis that is done, and what is being done.

    Returns
    -------
    (list of RankedEffect, list of CandidateFit)
        The ranking, best first, and every fit that was made.
    """
    if not order:  # the model has every effect that there is
        return [], []
    complete = thresholds.complete(before.excess, ideal_excess)

    def raised(fits: Sequence[CandidateFit]) -> list[CandidateFit]:
        report(0.6, "raising orders")
        return raise_orders(roles, before, fits, pool)

    def ranked(fits: Sequence[CandidateFit]) -> list[RankedEffect]:
        return rank(before, fits, known, thresholds, ideal_excess, len(order))

    fits = _first_fits(roles, model, before, order, known, pool, thresholds, ideal_excess, thorough, report)
    if thorough or not _settled(fits, before, thresholds, ideal_excess):
        fits = raised(fits)
    ranking = ranked(fits)
    if complete or any(r.worth_adding for r in ranking):
        return ranking, fits

    together: dict[str, CandidateFit] = {}

    def jointly(with_candidate: Mapping[str, Model]) -> list[RankedEffect]:
        report(0.7, TOGETHER)
        for fit in try_together_with_present(roles, with_candidate, pool):
            known_fit = together.get(fit.effect, fit)
            together[fit.effect] = min(known_fit, fit, key=lambda f: f.held_out.excess)
        without, *others = together.values()
        found = rank(without.held_out, others, known, thresholds, ideal_excess, len(order))
        return [*found, *(r for r in ranking if r.effect.name not in together)]

    if model.present:  # the screen lets them move, and sees what they hide
        first = screened_whole(roles, model, order[:FITTED_TOGETHER], pool)
        found = jointly({"": model, **{s.effect: model.having(s.start) for s in first}})
        if found[0].worth_adding and found[0].held_out.excess < CLEARLY * before.excess:
            return found, fits
    rest = [s for s in order if s.effect not in {f.effect for f in fits}]
    fits += raised(try_all(roles, model, rest, pool, report, 0.6, 0.7))
    ranking = ranked(fits)
    if model.present and not any(r.worth_adding for r in ranking):
        closest = sorted(fits, key=lambda f: f.held_out.excess)[:FITTED_TOGETHER]
        together = {name: together[name] for name in ("", *(f.effect for f in closest)) if name in together}
        ranking = jointly({f.effect: f.model for f in closest if _leads_farther(f, together)})
    return ranking, fits


def _leads_farther(alone: CandidateFit, together: Mapping[str, CandidateFit]) -> bool:
    """Whether a fit of all effects may end better where it begins at this fit of a candidate alone.

    Parameters
    ----------
    together : mapping of str to CandidateFit
        Fits of all effects so far, by candidate.
    """
    known = together.get(alone.effect)
    return known is None or alone.held_out.excess < known.held_out.excess


def _first_fits(
    roles: CaptureRoles,
    model: Model,
    before: PredictionErrors,
    order: Sequence[ScreenResult],
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds,
    ideal_excess: float,
    thorough: bool,
    report: Progress,
) -> list[CandidateFit]:
    """Fits of the candidates that the screen expects most of, and of those of which it says little."""
    most = max(order[0].removed_excess, 1e-12)
    promising = [s for s in order[:FITTED_FIRST] if s.removed_excess > 0.05 * most] or list(order[:1])
    # The screen says little of an effect whose derivatives do not reach, or that shows from capture to capture only.
    blind = [s for s in order if known[s.effect].rugged or known[s.effect].measure]
    wanted = promising + [s for s in blind if s not in promising]
    complete = thresholds.complete(before.excess, ideal_excess)
    if complete and not thresholds.may_be_worth_adding(before.excess, ideal_excess):
        return try_all(roles, model, wanted[:2], pool, report, 0.3, 0.6)
    if thorough:
        return try_all(roles, model, wanted, pool, report, 0.3, 0.6)
    least, shown = thresholds.excess, -math.inf
    if complete:
        shown = SHOWS * thresholds.least(ideal_excess)
        promising = [s for s in promising if s.removed_excess > shown]
    if model.present and expects_the_rest(order):
        # Present effects may have taken up a part of the one that explains the rest: the screen lets them move.
        first = [s for s in promising if s.after < NEAR * order[0].after + least]
        report(0.3, TOGETHER)
        fits = fit_with_present(roles, model, first, least, pool)
    else:
        first = [s for s in promising if s.removed_excess > RIVALS * order[0].removed_excess]
        fits = try_near(roles, model, first, [], least, pool, report, 0.3, 0.4, shown)
    if _settled(fits, before, thresholds, ideal_excess):
        return fits
    rest = [s for s in wanted if s not in first and (s in promising or s in blind)]
    # What is read off captures takes next to no time.
    read_off = [s for s in rest if known[s.effect].measure and not known[s.effect].rugged]
    fits += try_near(roles, model, read_off, fits, least, pool, report, 0.4, 0.45, shown)
    if _settled(fits, before, thresholds, ideal_excess):
        return fits
    rest = [s for s in rest if s not in read_off]
    return fits + try_near(roles, model, rest, fits, least, pool, report, 0.45, 0.6, shown)


def expects_the_rest(screened: Sequence[ScreenResult]) -> bool:
    """Whether the screen expects one effect, with the present ones free, to leave next to nothing."""
    return any(s.after < SETTLES * s.before for s in screened)


def _settled(
    fits: Sequence[CandidateFit], before: PredictionErrors, thresholds: Thresholds, ideal_excess: float
) -> bool:
    """Whether one fit leaves so little that no other candidate is asked for."""
    left = min((f.held_out.excess for f in fits), default=before.excess)
    least, most = thresholds.least(ideal_excess), thresholds.complete_excess
    unsure = least < left < most and left > SURELY_SETTLES * before.excess
    return left < SETTLES * before.excess and not unsure
