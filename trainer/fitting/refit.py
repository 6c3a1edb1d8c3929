"""Fits of whole models: one effect from its start, all effects together, and further numbers as far as these help."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import torch

from trainer.captures.batches import Batch, signal_variance
from trainer.fitting.gauss_newton import FitResult, fit
from trainer.fitting.jacobian import keys_of, remaining, stacked
from trainer.fitting.many_numbers import has_many
from trainer.fitting.predictor import Predictor
from trainer.fitting.start_points import pattern_search
from trainer.model.colours_apart import come_apart, may_come_apart
from trainer.model.model import EffectInstance, Model, raised

# Order from which a map goes on in free form, where its effect has one: terms grow as its square.
POLYNOMIALS = 6
SEARCH_PIXELS = 2 * 240 * 320  # of a scene, at least one capture: a pattern search need only come near
SEARCH_SCENES = 3
# An iris's edge goes one frequency sample a step: its fit goes on while each turn leaves less than this share.
RUGGED_TURNS, RUGGED_LEFT = 3, 0.8
# Of the excess that an order must remove: where a straight line expects less, it is not fitted.
LEAST_EXPECTED = 0.5
# What further numbers of an effect are: of its next order, of each colour for itself, or of both (not at once).
Further = tuple[str, str]
ORDER, APART, BOTH = "order", "apart", "both"
# Orders are raised at once where each expects this share of what the one that expects most does: what others expect may
# be its doing.
RIVALS = 0.3


def settled(model: Model, batches: Sequence[Batch]) -> FitResult:
    """The model with all of its effects fitted together, and their orders raised as far as that helps."""
    return raise_orders(fit(model, model.names, batches), model.names, batches, least_for_order)


def fit_from(
    model: Model, start: EffectInstance, batches: Sequence[Batch], iterations: int = 12
) -> FitResult:
    """Fit one effect from a start; where derivatives do not reach far, after a pattern search and in turns."""
    if start.effect.rugged:
        with torch.no_grad():
            few = [
                telling(model, b, max(1, SEARCH_PIXELS // b.signal[0].numel()))
                for b in batches[:SEARCH_SCENES]
            ]
            predictors = [Predictor(model.having(start), b) for b in few]
            points = [p.trace(model) for p in predictors]
            start = pattern_search(model, predictors, points, start)
    fitted = fit(model.having(start), [start.effect.name], batches, iterations)
    turns = RUGGED_TURNS if start.effect.rugged else 1
    before = math.inf
    while not fitted.settled and turns > 1 and fitted.errors.excess < RUGGED_LEFT * before:
        before, turns = fitted.errors.excess, turns - 1
        fitted = fit(fitted.model, [start.effect.name], batches, iterations)
    return fitted


def least_for_order(excess: float) -> float:
    """Excess that a higher order must remove: a twentieth of what is left, and more than what noise can."""
    return max(0.05 * excess, 1e-5)


def next_order(present: EffectInstance) -> int | None:
    """The order that an effect's map or curve is raised to next; None where there is none, or free form goes on."""
    higher = [o for o in present.effect.orders if o > present.order]
    form = present.effect.free_form
    ended = form is not None and not form.curve and present.order >= POLYNOMIALS
    return None if not higher or ended or present.nodes is not None else higher[0]


def raise_orders(
    fitted: FitResult,
    names: Sequence[str],
    batches: Sequence[Batch],
    gain_needed: Callable[[float], float],
    hold: float = 0.0,
    fixed: Collection[tuple[str, str]] = (),
) -> FitResult:
    """Raise the orders of effects' maps or curves, of all that pay at once, while the error keeps falling.

    A map that can go on in free form is raised to order POLYNOMIALS only: beyond it splines cost less.

    Parameters
    ----------
    fitted : FitResult
        Of a model with the effects.
    names : sequence of str
        The effects; the others keep their values.
    gain_needed : callable
        How much excess a higher order must remove to be kept, from the excess that there is.
    hold, fixed
        As for `fit`; effects with a fixed parameter keep their orders.
    """
    rising = [n for n in names if n not in {name for name, _ in fixed}]
    while True:
        needed = gain_needed(fitted.errors.excess)
        trial = _with_numbers_that_pay(fitted.model, names, rising, batches, LEAST_EXPECTED * needed)
        if trial is None:
            return fitted
        better = fit(trial, names, batches, iterations=8, hold=hold, fixed=fixed)
        if fitted.errors.excess - better.errors.excess < needed:
            return fitted
        fitted = better


@torch.no_grad()
def _with_numbers_that_pay(
    model: Model, names: Sequence[str], rising: Sequence[str], batches: Sequence[Batch], least: float
) -> Model | None:
    """The model with further numbers, absent, of those effects that a straight-line step expects so much excess of.

    Further numbers are those of an effect's next order, and those that each colour has for itself. The step is that of
    all of them and everything that is fitted, on the most telling capture of each batch. Of those that expect the same,
    the one that expects most is taken, and beside it those that expect about as much of what is left.

    Parameters
    ----------
    least : float
        Excess that further numbers must be expected to remove, beside those that are taken already.

    Returns
    -------
    Model or None
        None where nothing pays.
    """
    every = model
    colours = {b.channel for b in batches}
    for name in rising:
        present = model.instance(name)
        order = next_order(present)
        trial = present if order is None else raised(present, model.bench, order)
        if len(colours) > 1 and may_come_apart(trial, model.bench):
            alone = come_apart(trial, model.bench)
            trial = trial if has_many(alone) else alone
        every = every.having(trial) if trial is not present else every
    if every is model:
        return None
    few = [telling(model, b, 1) for b in batches]
    predictors = [Predictor(every, b) for b in few]
    points = [p.trace(every) for p in predictors]
    keys = keys_of(every, [n for n in names if not has_many(every.instance(n))])
    residual, slopes = stacked(every, keys, predictors, points)
    own = [_meaning(key, every, model) for key in keys]
    kinds: list[Further | None] = [None] * len(slopes)
    for k, (key, (kind, first)) in enumerate(zip(keys, own, strict=True)):
        kinds[k] = kind
        if first != key[2]:  # what colours have in common is the sum of their slopes
            slopes[keys.index((*key[:2], first))] += slopes[k]
    scale = signal_variance(few)

    def left(taken: Sequence[Further]) -> float:
        return remaining(residual, slopes[[kind is None or kind in taken for kind in kinds]]) / scale

    taken: list[Further] = []
    before = left(taken)
    offered = [kind for kind in dict.fromkeys(kinds) if kind is not None and kind[1] != BOTH]
    while rest := [kind for kind in offered if kind not in taken]:
        after = {kind: left([*taken, kind]) for kind in rest}
        best = min(rest, key=lambda kind: after[kind])
        if before - after[best] < least:
            break
        least = max(least, RIVALS * (before - after[best]))
        taken.append(best)
        before = after[best]
    for name, what in taken:
        present = model.instance(name)
        order = next_order(present)
        if what == APART:
            model = model.having(come_apart(present, model.bench))
        elif order is not None:
            model = model.having(raised(present, model.bench, order))
    return model if taken else None


def telling(model: Model, batch: Batch, count: int) -> Batch:
    """The captures of a batch of which a model leaves most unexplained, in counts, in their order."""
    left = (batch.mask * (batch.signal - Predictor(model, batch).predict(model)) ** 2).sum((1, 2))
    return batch.only(sorted(left.argsort(descending=True)[:count].tolist()))


def _meaning(key: tuple[str, str, int], every: Model, lower: Model) -> tuple[Further | None, int]:
    """What a number of the larger model is a part of, None for one that is there already.

    And the index of the first colour's number that stands for all colours' together: its own where colours have it for
    themselves in both models.
    """
    name, parameter, index = key
    large, small = every.instance(name), lower.instance(name)
    p, before = large.effect.parameter(parameter), small.effect.parameter(parameter)
    size = large.values[parameter].size
    rows = len(every.bench.channels) if p.per_channel else 1
    rows_before = len(every.bench.channels) if before.per_channel else 1
    block = size // (rows * p.blocks)
    is_higher = index % block >= small.values[parameter].size // (rows_before * p.blocks) if block else False
    if rows == rows_before:
        return ((name, ORDER) if is_higher else None), index
    row, first = divmod(index, size // rows)
    if row == 0:
        return ((name, ORDER) if is_higher else None), first
    return ((name, BOTH if is_higher else APART)), first
