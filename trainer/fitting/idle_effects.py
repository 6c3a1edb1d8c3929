"""Effects of a model that do nothing of their own: a straight-line step of the others makes what they change."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from trainer.captures.batches import Batch, signal_variance
from trainer.fitting.dependence import dependence
from trainer.fitting.jacobian import keys_of
from trainer.fitting.many_numbers import has_many
from trainer.fitting.predictor import telling
from trainer.model.model import Model


def without_idle(model: Model, batches: Sequence[Batch], least: float) -> Model:
    """A model without the effects that do nothing of their own, all of them at once; the others do what they did.

    Effects that are measured, and those of many numbers, stay.

    Parameters
    ----------
    batches : sequence of Batch
        Of each, the most telling capture is looked at.
    least : float
        Excess that makes no difference.
    """
    batches = most_telling(model, batches)
    numbers, scale = dependence(model, batches), signal_variance(batches)
    may_go = [n for n in model.names if model.instance(n).effect.measure is None and _in_table(model, n)]
    idle: list[str] = []
    while may_go:
        changes = {name: numbers.change_without({*idle, name}) for name in may_go}
        least_missed = min(may_go, key=changes.__getitem__)
        if changes[least_missed] > least * scale:
            break
        idle.append(least_missed)
        may_go.remove(least_missed)
    return numbers.without(idle) if idle else model


def most_telling(model: Model, batches: Sequence[Batch]) -> list[Batch]:
    """Of each batch the capture of which the model leaves most unexplained."""
    with torch.no_grad():
        return [telling(model, b, 1) for b in batches]


def _in_table(model: Model, name: str) -> bool:
    """Whether an effect has numbers for a table of derivatives, and not too many."""
    return not has_many(model.instance(name)) and bool(keys_of(model, [name]))
