"""Fits of whole models: one effect from its start, all effects together, and further numbers as far as these help."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import torch

from trainer.captures.batches import Batch
from trainer.fitting.further_numbers import with_numbers_that_pay
from trainer.fitting.gauss_newton import ROUGH, FitResult, fit
from trainer.fitting.predictor import Predictor, telling, telling_batches
from trainer.fitting.start_points import pattern_search
from trainer.model.model import EffectInstance, Model

# A pattern search need only come near: of so many colours and planes, and with so many pixels in all, or one capture.
SEARCH_SCENES, SEARCH_PIXELS = 3, 6 * 240 * 320
# An iris's edge goes one frequency sample a step: its fit goes on while each turn leaves less than this share.
RUGGED_TURNS, RUGGED_LEFT = 3, 0.8
NOTHING = 5e-5  # excess, a tenth of what a complete model may leave: captures say no more of it
# Of the excess that further numbers must remove: where a straight line expects less, it is not fitted.
LEAST_EXPECTED = 0.5


def settled(model: Model, batches: Sequence[Batch]) -> FitResult:
    """The model with all of its effects fitted together, and their orders raised as far as that helps."""
    return raise_orders(fit(model, model.names, batches), model.names, batches, least_for_order)


def fit_from(
    model: Model,
    start: EffectInstance,
    batches: Sequence[Batch],
    iterations: int = 12,
    enough: float = math.inf,
) -> FitResult:
    """Fit one effect from a start; where derivatives do not reach far, after a pattern search and in turns.

    Parameters
    ----------
    enough : float
        Excess at which the fit is of use: it is given up where it will hardly come there.
    """
    if start.effect.rugged:
        with torch.no_grad():
            few = _for_search(model, batches)
            predictors = [Predictor(model.having(start), b) for b in few]
            points = [p.trace(model) for p in predictors]
            start = pattern_search(model, predictors, points, start)
    # With the gains of a model without the effect, a right start may look wrong, and the fit leaves it.
    begun = replace(model.having(start), gain={})
    fitted = fit(begun, [start.effect.name], batches, iterations, ROUGH, enough=enough)
    turns = RUGGED_TURNS if start.effect.rugged else 1
    before = math.inf
    while not fitted.settled and turns > 1 and fitted.errors.excess < min(RUGGED_LEFT * before, enough):
        before, turns = fitted.errors.excess, turns - 1
        fitted = fit(fitted.model, [start.effect.name], batches, iterations, ROUGH)
    return fitted


def _for_search(model: Model, batches: Sequence[Batch]) -> list[Batch]:
    """Captures for a pattern search, of which a model leaves most unexplained."""
    pixels = batches[0].signal[0].numel()
    scenes = min(SEARCH_SCENES, max(1, SEARCH_PIXELS // pixels))
    each = max(1, SEARCH_PIXELS // (SEARCH_SCENES * pixels))
    return [telling(model, b, each) for b in telling_batches(model, batches, scenes)]


def least_for_order(excess: float) -> float:
    """Excess that a higher order must remove: a twentieth of what is left, and more than what noise can.

    None removes enough where next to nothing is left.
    """
    return math.inf if excess < NOTHING else max(0.05 * excess, 1e-5)


def raise_orders(
    fitted: FitResult,
    names: Sequence[str],
    batches: Sequence[Batch],
    gain_needed: Callable[[float], float],
    hold: float = 0.0,
    fixed: Collection[tuple[str, str]] = (),
) -> FitResult:
    """Raise the orders of effects' maps or curves, and take colours apart, while the error keeps falling.

    All that pays goes at once. A map that can go on in free form is raised to order POLYNOMIALS only: beyond it splines
    cost less.

    Parameters
    ----------
    fitted : FitResult
        Of a model with the effects.
    names : sequence of str
        The effects; the others keep their values.
    gain_needed : callable
        How much excess further numbers must remove to be kept, from the excess that there is.
    hold, fixed
        As for `fit`; effects with a fixed parameter get no further numbers.
    """
    rising = [n for n in names if n not in {name for name, _ in fixed}]
    while True:
        needed = gain_needed(fitted.errors.excess)
        if needed > fitted.errors.excess:
            return fitted
        further = with_numbers_that_pay(fitted.model, names, rising, batches, LEAST_EXPECTED * needed, fixed)
        if further is None:
            return fitted
        enough = fitted.errors.excess - needed
        trial, slopes = further
        better = fit(trial, names, batches, 8, ROUGH, hold=hold, fixed=fixed, enough=enough, slopes=slopes)
        if better.errors.excess > enough:
            return fitted
        fitted = better
