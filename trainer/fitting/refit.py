"""Fits of whole models: one effect from its start, all effects together, and orders raised as far as that helps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from runtime.excess import joined
from trainer.captures.batches import Batch
from trainer.fitting.gauss_newton import FitResult, fit
from trainer.fitting.jacobian import keys_of, remaining, stacked
from trainer.fitting.many_numbers import has_many
from trainer.fitting.predictor import Predictor
from trainer.fitting.start_points import pattern_search
from trainer.model.model import EffectInstance, Model, raised

# Order from which a map goes on in free form, where its effect has one: terms grow as its square.
POLYNOMIALS = 6
SEARCH_PIXELS = 2 * 240 * 320  # of a scene, at least one capture: a pattern search need only come near
SEARCH_SCENES = 3
LEAST_EXPECTED = (
    0.5  # of the excess that an order must remove: where a straight line expects less, it is not fitted
)


def settled(model: Model, batches: Sequence[Batch]) -> FitResult:
    """The model with all of its effects fitted together, and their orders raised as far as that helps."""
    fitted = fit(model, model.names, batches)
    for name in model.names:
        fitted = raise_order(fitted, name, batches, least_for_order, model.names)
    return fitted


def fit_from(
    model: Model, start: EffectInstance, batches: Sequence[Batch], iterations: int = 12
) -> FitResult:
    """Fit one effect from a start; where derivatives do not reach far, after a pattern search."""
    if start.effect.rugged:
        with torch.no_grad():
            few = [
                _telling(model, b, max(1, SEARCH_PIXELS // b.signal[0].numel()))
                for b in batches[:SEARCH_SCENES]
            ]
            predictors = [Predictor(model.having(start), b) for b in few]
            points = [p.trace(model) for p in predictors]
            start = pattern_search(model, predictors, points, start)
    return fit(model.having(start), [start.effect.name], batches, iterations)


def least_for_order(excess: float) -> float:
    """Excess that a higher order must remove: a twentieth of what is left, and more than what noise can."""
    return max(0.05 * excess, 1e-5)


def next_order(present: EffectInstance) -> int | None:
    """The order that an effect's map or curve is raised to next; None where there is none, or free form goes on."""
    higher = [o for o in present.effect.orders if o > present.order]
    form = present.effect.free_form
    ended = form is not None and not form.curve and present.order >= POLYNOMIALS
    return None if not higher or ended or present.nodes is not None else higher[0]


def raise_order(
    fitted: FitResult,
    name: str,
    batches: Sequence[Batch],
    gain_needed: Callable[[float], float],
    free: Sequence[str] | None = None,
) -> FitResult:
    """Raise the order of an effect's map or curve while the error keeps falling.

    A map that can go on in free form is raised to order POLYNOMIALS only: beyond it splines cost less.

    Parameters
    ----------
    fitted : FitResult
        Of a model with the effect.
    gain_needed : callable
        How much excess a higher order must remove to be kept, from the excess that there is.
    free : sequence of str, optional
        Effects that are refitted too; the effect alone by default.
    """
    while True:
        present = fitted.model.instance(name)
        higher = next_order(present)
        if higher is None:
            return fitted
        trial = fitted.model.having(raised(present, fitted.model.bench, higher))
        needed = gain_needed(fitted.errors.excess)
        if _expected_gain(trial, present, free or [name], batches) < LEAST_EXPECTED * needed:
            return fitted
        better = fit(trial, free or [name], batches, iterations=8)
        if fitted.errors.excess - better.errors.excess < needed:
            return fitted
        fitted = better


@torch.no_grad()
def _expected_gain(
    trial: Model, lower: EffectInstance, free: Sequence[str], batches: Sequence[Batch]
) -> float:
    """Excess that a straight-line step of an effect's new terms removes, on the most telling capture of each batch.

    Parameters
    ----------
    trial : Model
        With the effect at a higher order, its new terms absent.
    lower : EffectInstance
        The effect at the order before.
    """
    few = [_telling(trial, b, 1) for b in batches]
    predictors = [Predictor(trial, b) for b in few]
    points = [p.trace(trial) for p in predictors]
    keys = keys_of(trial, [n for n in free if not has_many(trial.instance(n))])
    residual, slopes = stacked(trial, keys, predictors, points)
    known = [not _is_new(key, trial, lower) for key in keys] + [True] * (len(slopes) - len(keys))
    removed = remaining(residual, slopes[known]) - remaining(residual, slopes)
    return removed / float(joined([b.errors(torch.zeros_like(b.signal)) for b in few]).variance.sum())


def _telling(model: Model, batch: Batch, count: int) -> Batch:
    """The captures of a batch of which a model leaves most unexplained, in counts, in their order."""
    left = (batch.mask * (batch.signal - Predictor(model, batch).predict(model)) ** 2).sum((1, 2))
    return batch.only(sorted(left.argsort(descending=True)[:count].tolist()))


def _is_new(key: tuple[str, str, int], trial: Model, lower: EffectInstance) -> bool:
    """Whether a number is one that the effect did not have at the lower order."""
    name, parameter, index = key
    if name != lower.effect.name:
        return False
    p = lower.effect.parameter(parameter)
    rows = (len(trial.bench.channels) if p.per_channel else 1) * p.blocks
    before = lower.values[parameter].size // rows
    now = trial.instance(name).values[parameter].size // rows
    return index % now >= before
