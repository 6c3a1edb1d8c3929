"""Effects of a model that do nothing of their own: a straight-line step of the others makes what they change."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import torch

from trainer.captures.batches import Batch, signal_variance
from trainer.fitting.jacobian import away_from_absent, keys_of, outside_span, stacked
from trainer.fitting.many_numbers import has_many
from trainer.fitting.predictor import Predictor, telling
from trainer.model.model import Model


def without_idle(model: Model, batches: Sequence[Batch], least: float) -> Model:
    """A model without the effects that do nothing of their own, all of them at once; the others stay as they are.

    Effects that are measured, and those of many numbers, stay.

    Parameters
    ----------
    batches : sequence of Batch
        Of each, the most telling capture is looked at.
    least : float
        Excess that makes no difference.
    """
    batches = most_telling(model, batches)
    change_without, scale = changes_without(model, batches), signal_variance(batches)
    may_go = [n for n in model.names if model.instance(n).effect.measure is None and _in_table(model, n)]
    idle: list[str] = []
    while may_go:
        changes = {name: change_without({*idle, name}) for name in may_go}
        least_missed = min(may_go, key=changes.__getitem__)
        if changes[least_missed] > least * scale:
            break
        idle.append(least_missed)
        may_go.remove(least_missed)
    for name in idle:
        model = model.without(name)
    return model


def most_telling(model: Model, batches: Sequence[Batch]) -> list[Batch]:
    """Of each batch the capture of which the model leaves most unexplained."""
    with torch.no_grad():
        return [telling(model, b, 1) for b in batches]


@torch.no_grad()
def changes_without(model: Model, batches: Sequence[Batch]) -> Callable[[Collection[str]], float]:
    """What the lack of some effects changes that a straight-line step of the others does not: a sum of squares, counts.

    Zero for effects without a table of derivatives.
    """
    predictors = [Predictor(model, b) for b in batches]
    keys = keys_of(model, [n for n in model.names if not has_many(model.instance(n))])
    _, slopes = stacked(model, keys, predictors, [p.trace(model) for p in predictors])
    products = (slopes @ slopes.T).double()
    away = torch.zeros(len(products), dtype=torch.float64)  # the colours' gains, at the end, stay
    away[: len(keys)] = torch.tensor([away_from_absent(model, key) for key in keys], dtype=torch.float64)

    def change_without(names: Collection[str]) -> float:
        gone = torch.tensor([k < len(keys) and keys[k][0] in names for k in range(len(products))])
        along = products[:, gone] @ away[gone]
        return outside_span(float(away[gone] @ along[gone]), along[~gone], products[~gone][:, ~gone])

    return change_without


def _in_table(model: Model, name: str) -> bool:
    """Whether an effect has numbers for a table of derivatives, and not too many."""
    return not has_many(model.instance(name)) and bool(keys_of(model, [name]))
