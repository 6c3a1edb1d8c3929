"""Fits of one candidate effect on a model, judged on held-out captures: tasks that any process can run."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from runtime.excess import PredictionErrors
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, chosen, opened
from trainer.fitting.gauss_newton import ROUGH, FitResult, fit
from trainer.fitting.predictor import evaluate_captures, excess_on
from trainer.fitting.refit import fit_from, least_for_order, raise_orders, settled
from trainer.model.model import EffectInstance, Model, absent

# An effect that starts anew is back where it was where it leaves the excess that there was, up to the first of these
# factors, and nowhere near where it leaves more than the second times as much.
BACK, NOWHERE = 1.1, 10.0
# Times what a model leaves of a few captures: where one effect less leaves more, it is missed.
FEW_MISS = 3.0
THERE = 0.5  # of what there is: what a fit to few captures leaves of all at most where a fit to all may begin at once


@dataclass(frozen=True)
class CandidateFit:
    """A fitted candidate.

    Attributes
    ----------
    effect : str
        Name of the candidate.
    model : Model
        With the candidate in it.
    held_out : PredictionErrors
        Errors of `model` on the held-out captures.
    together : FitResult or None
        Of `model`, where all of its effects were fitted together.
    """

    effect: str
    model: Model
    held_out: PredictionErrors
    together: FitResult | None = None


def try_effect(
    folder: Path,
    ids: tuple[str, ...],
    held_ids: tuple[str, ...],
    model: Model,
    start: EffectInstance,
    raising: bool,
    iterations: int = 8,
) -> CandidateFit:
    """Fit one effect, with present ones as they are, and judge it on held-out captures.

    Parameters
    ----------
    folder : Path
        Of the capture set.
    ids, held_ids : tuple of str
        Captures to fit, and captures to judge by.
    raising : bool
        Raise the effect's order as far as that helps.
    """
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    name = start.effect.name
    fitted = fit_from(model, start, batches, iterations)
    if raising:
        fitted = raise_orders(fitted, [name], batches, least_for_order)
    return _judged(name, fitted.model, captures, held_ids)


def try_on_few(
    folder: Path,
    few: tuple[str, ...],
    ids: tuple[str, ...],
    held_ids: tuple[str, ...],
    model: Model,
    start: EffectInstance,
    enough: float,
    most: float = math.inf,
) -> tuple[Model, float, CandidateFit | None]:
    """Fit one effect, with present ones as they are, to a few captures; where it explains these, to all.

    Parameters
    ----------
    few : tuple of str
        Captures to fit first.
    ids, held_ids : tuple of str
        Captures to fit then, and captures to judge by.
    enough : float
        Excess of the few captures from which on the fit goes on to all.
    most : float
        Excess of the few captures that is of interest: a fit that will hardly come there is given up.

    Returns
    -------
    (Model, float, CandidateFit or None)
        The model fitted to few captures, and its excess on these same captures: what it cannot explain of them, it
        cannot explain of all. Then the fit to all captures, where it leaves no more than `enough` of the few.
    """
    captures = opened(folder)
    fitted = fit_from(model, start, load(captures, chosen(captures, few)), iterations=8, enough=most)
    further = None
    if fitted.errors.excess <= enough:
        further = try_further(folder, ids, held_ids, fitted.model, start.effect.name, False)
    return fitted.model, fitted.errors.excess, further


def try_together_on_few(
    folder: Path, ids: tuple[str, ...], model: Model, start: EffectInstance, enough: float = math.inf
) -> tuple[Model, float]:
    """A model with one effect more, all fitted to a few captures alone, and its excess on these.

    Parameters
    ----------
    enough : float
        Excess of interest: a fit that will hardly come near is given up.
    """
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    started = fit_from(model, start, batches, iterations=8).model
    fitted = fit(started, started.names, batches, 8, ROUGH, enough=enough)
    return fitted.model, fitted.errors.excess


def try_further(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, name: str, raising: bool
) -> CandidateFit:
    """Go on with the fit of effect `name` from where it is in a model, as `try_effect` does from a start."""
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    fitted = fit(model, [name], batches, 8, ROUGH)
    if raising:
        fitted = raise_orders(fitted, [name], batches, least_for_order)
    return _judged(name, fitted.model, captures, held_ids)


def try_again(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, name: str
) -> CandidateFit | None:
    """Fit effect `name` of a model anew from where it does nothing, then all effects together.

    Returns
    -------
    CandidateFit or None
        None where it alone comes back to where it was, or nowhere near: to fit all together would change nothing.
    """
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    present = model.instance(name)
    fresh = absent(present.effect, model.bench, present.order)
    alone = fit(model.having(fresh), [name], batches, 8, ROUGH)
    was = excess_on(model, batches)
    if was / BACK < alone.errors.excess < was * BACK or alone.errors.excess > NOWHERE * was:
        return None
    return _judged(name, settled(alone.model, batches).model, captures, held_ids)


def try_without(
    folder: Path,
    few: tuple[str, ...],
    ids: tuple[str, ...],
    held_ids: tuple[str, ...],
    model: Model,
    name: str,
    least: float,
) -> CandidateFit | None:
    """Fit a model without effect `name`, all others from where they do nothing; maps and measured effects stay.

    Parameters
    ----------
    few : tuple of str
        Captures to fit first: what is left of these must be of interest.
    least : float
        Excess that makes no difference.

    Returns
    -------
    CandidateFit or None
        Of the effect that is left out. None where the few captures miss it.
    """
    captures = opened(folder)
    first = load(captures, chosen(captures, few))
    most = max(FEW_MISS * excess_on(model, first), least)
    rest = model.without(name)
    for present in rest.present:
        if present.nodes is None and present.effect.measure is None:
            rest = rest.having(absent(present.effect, model.bench, present.order))
    started = fit(rest, rest.names, first, 16, ROUGH, enough=most)
    if started.errors.excess > most:
        return None
    fitted = settled(started.model, load(captures, chosen(captures, ids)))
    return _judged(name, fitted.model, captures, held_ids)


def try_together(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, name: str
) -> CandidateFit:
    """Fit all effects of a model together, and judge it on held-out captures as an explanation by effect `name`."""
    captures = opened(folder)
    fitted = settled(model, load(captures, chosen(captures, ids)))
    return _judged(name, fitted.model, captures, held_ids)


def try_with_present(
    folder: Path,
    ids: tuple[str, ...],
    held_ids: tuple[str, ...],
    model: Model,
    start: EffectInstance,
    on_few: Model | None = None,
) -> CandidateFit:
    """Fit one effect to a model, then all of its effects together at the orders that they have, and judge it.

    Parameters
    ----------
    on_few : Model, optional
        The same, all fitted to a few of the captures: where to begin, if that leaves less than the effect alone, which
        is not fitted where it leaves less than half of what there is.
    """
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    left = math.inf if on_few is None else excess_on(on_few, batches)
    started = on_few
    if on_few is None or left > THERE * excess_on(model, batches):
        alone = fit_from(model, start, batches, iterations=8)
        started = on_few if left < alone.errors.excess else alone.model
    assert started is not None
    together = fit(started, started.names, batches)
    return replace(_judged(start.effect.name, together.model, captures, held_ids), together=together)


def _judged(name: str, model: Model, captures: CaptureSet, held_ids: tuple[str, ...]) -> CandidateFit:
    return CandidateFit(name, model, evaluate_captures(captures, chosen(captures, held_ids), model))
