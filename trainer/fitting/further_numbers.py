"""Further numbers of the effects in a model: those of an effect's next order, and those of each colour for itself."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from trainer.captures.batches import Batch, signal_variance
from trainer.fitting.jacobian import Key, keys_of, outside_span, slopes_of, weighted_residuals
from trainer.fitting.many_numbers import has_many
from trainer.fitting.predictor import Predictor, telling
from trainer.model.colours_apart import come_apart, may_come_apart
from trainer.model.model import EffectInstance, Model, raised

# Order from which a map goes on in free form, where its effect has one: terms grow as its square.
POLYNOMIALS = 6
# What further numbers of an effect are: of its next order, of each colour for itself, or of both (not at once).
Further = tuple[str, str]
ORDER, APART, BOTH = "order", "apart", "both"
# Further numbers come at once where each expects this share of what the one that expects most does: what others expect
# may be its doing.
RIVALS = 0.3


def next_order(present: EffectInstance) -> int | None:
    """The order that an effect's map or curve is raised to next; None where there is none, or free form goes on."""
    higher = [o for o in present.effect.orders if o > present.order]
    form = present.effect.free_form
    ended = form is not None and not form.curve and present.order >= POLYNOMIALS
    return None if not higher or ended or present.nodes is not None else higher[0]


@torch.no_grad()
def with_numbers_that_pay(
    model: Model,
    names: Sequence[str],
    rising: Sequence[str],
    batches: Sequence[Batch],
    least: float,
    fixed: Collection[tuple[str, str]] = (),
) -> tuple[Model, list[Tensor] | None] | None:
    """The model with further numbers, absent, of those effects that a straight-line step expects so much excess of.

    Further numbers are those of an effect's next order, and those that each colour has for itself. The step is that of
    all of them and everything that is fitted, on the most telling capture of each batch. Of those that expect the same,
    the one that expects most is taken, and beside it those that expect about as much of what is left.

    Parameters
    ----------
    least : float
        Excess that further numbers must be expected to remove, beside those that are taken already.
    fixed : collection of (str, str)
        Effects and those of their parameters that keep their values.

    Returns
    -------
    (Model, list of Tensor or None) or None
        The model, and the batches' derivatives there, as a fit of it needs them, where they are known: of one colour,
        and of single captures. None where nothing pays.
    """
    every = _with_all(model, rising, batches)
    if every is model:
        return None
    few = [telling(model, b, 1) for b in batches]
    predictors = [Predictor(every, b) for b in few]
    points = [p.trace(every) for p in predictors]
    in_table = keys_of(every, [n for n in names if not has_many(every.instance(n))])
    keys = tuple(key for key in in_table if key[:2] not in fixed)
    channels = list(dict.fromkeys(b.channel for b in few))
    tables = slopes_of(every, keys, channels, predictors, points)
    residual, slopes = torch.cat(weighted_residuals(every, predictors, points)[0]), torch.cat(tables, dim=1)
    kinds: list[Further | None] = [None] * len(slopes)
    for k, key in enumerate(keys):
        kinds[k], first = _meaning(key, every, model)
        if first != key[2]:  # what colours have in common is the sum of their slopes
            slopes[keys.index((*key[:2], first))] += slopes[k]
    scale = signal_variance(few)
    total = float((residual.double() ** 2).sum())
    along, normal = (slopes @ residual).double(), (slopes @ slopes.T).double()

    def left(taken: Sequence[Further]) -> float:
        free = torch.tensor([kind is None or kind in taken for kind in kinds])
        return outside_span(total, along[free], normal[free][:, free]) / scale

    offered = [kind for kind in dict.fromkeys(kinds) if kind is not None and kind[1] != BOTH]
    taken: list[Further] = []
    before = left(taken)
    while rest := [kind for kind in offered if kind not in taken]:
        after = {kind: left([*taken, kind]) for kind in rest}
        best = min(rest, key=lambda kind: after[kind])
        if before - after[best] < least:
            break
        least = max(least, RIVALS * (before - after[best]))
        taken.append(best)
        before = after[best]
    if not taken:
        return None
    for name, what in taken:
        present = model.instance(name)
        further = come_apart(present, model.bench) if what == APART else _raised(present, model)
        model = model.having(further)
    whole = len(channels) == 1 and all(len(b.ids) == 1 for b in batches)
    if not whole or any(p.has_own_gains(model) for p in predictors):
        return model, None
    kept = [k for k, kind in enumerate(kinds) if kind is None or kind in taken]
    return model, [table[kept] for table in tables]


def _with_all(model: Model, rising: Sequence[str], batches: Sequence[Batch]) -> Model:
    """The model with all further numbers that these effects may have, absent."""
    every, colours = model, {b.channel for b in batches}
    for name in rising:
        present = model.instance(name)
        trial = _raised(present, model)
        if len(colours) > 1 and may_come_apart(trial, model.bench):
            alone = come_apart(trial, model.bench)
            trial = trial if has_many(alone) else alone
        every = every if trial is present else every.having(trial)
    return every


def _raised(present: EffectInstance, model: Model) -> EffectInstance:
    """The effect at its next order; the same where it has none."""
    order = next_order(present)
    return present if order is None else raised(present, model.bench, order)


def _meaning(key: Key, every: Model, lower: Model) -> tuple[Further | None, int]:
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
