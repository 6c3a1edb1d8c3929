"""How far the numbers of a model do each other's work: what the others take over where an effect is taken out."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from trainer.captures.batches import Batch
from trainer.fitting.jacobian import (
    Key,
    away_from_absent,
    keys_of,
    moved,
    outside_span,
    reach_of,
    stacked,
    step_within,
)
from trainer.fitting.many_numbers import has_many
from trainer.fitting.predictor import Predictor, excess_on
from trainer.model.model import Model

# Of the straight-line step of the others: what they change is not always as straight as that.
SHARES = (1.0, 0.5, 0.0)
SLACK = 1e-4  # of each number's own square: a step leaves alone what changes next to nothing


@dataclass(frozen=True)
class Dependence:
    """How far the numbers of a model do each other's work, on some captures.

    Attributes
    ----------
    model : Model
    batches : sequence of Batch
    keys : tuple
        (effect, parameter, index into its values) of each number; of effects of many numbers, none.
    channels : tuple of str
        Colours of the captures.
    products : Tensor [keys + colours, keys + colours]
        Of what each number changes, with each other; the logarithms of the colours' gains come last.
    away : Tensor [keys + colours]
        How far each number is from "absent", physical units; 0 for gains, which stay.
    """

    model: Model
    batches: Sequence[Batch]
    keys: tuple[Key, ...]
    channels: tuple[str, ...]
    products: Tensor
    away: Tensor

    def change_without(self, names: Collection[str]) -> float:
        """What the lack of effects changes that a straight-line step of the others does not: a sum of squares, counts.

        Zero for effects of many numbers.
        """
        gone, along = self._lack(self._of(names))
        return outside_span(float(self.away[gone] @ along[gone]), along[~gone], self._others(gone))

    def without(self, names: Collection[str]) -> Model:
        """The model without effects, the others moved to do their work, as `without_numbers` does."""
        rest = self.without_numbers(self._of(names))
        for name in names:
            rest = rest.without(name)
        return rest

    def without_numbers(self, lost: Collection[Key]) -> Model:
        """The model with numbers as if "absent", the others moved to do their work, as far as a straight line says how.

        By the share of that step, of SHARES, that leaves least on the captures.
        """
        gone, along = self._lack(lost)
        if not bool(self.away[gone].any()):
            return self.model
        step, stays = -self.away.numpy(), ~gone.numpy()
        low, high = reach_of(self.model, self.keys, self.channels)
        within = low[stays], high[stays]
        step[stays] = step_within(self._others(gone).numpy(), along[~gone].numpy(), SLACK, within)
        steps = (np.where(stays, share * step, step) for share in SHARES)
        tried = [moved(self.model, self.keys, self.channels, one) for one in steps]
        return min(tried, key=lambda one: excess_on(one, self.batches))

    def _of(self, names: Collection[str]) -> list[Key]:
        return [key for key in self.keys if key[0] in names]

    def _lack(self, lost: Collection[Key]) -> tuple[Tensor, Tensor]:
        """Which numbers are lost, and the products of all with what their lack changes."""
        gone = torch.tensor([key in lost for key in self.keys] + [False] * len(self.channels))
        return gone, self.products[:, gone] @ self.away[gone]

    def _others(self, gone: Tensor) -> Tensor:
        return self.products[~gone][:, ~gone]


@torch.no_grad()
def dependence(model: Model, batches: Sequence[Batch]) -> Dependence:
    """How far the numbers of a model do each other's work on these captures."""
    predictors = [Predictor(model, b) for b in batches]
    keys = keys_of(model, [n for n in model.names if not has_many(model.instance(n))])
    _, slopes = stacked(model, keys, predictors, [p.trace(model) for p in predictors])
    channels = tuple(dict.fromkeys(b.channel for b in batches))
    away = np.array([away_from_absent(model, key) for key in keys] + [0.0] * len(channels))
    products = (slopes @ slopes.T).double()
    return Dependence(model, batches, keys, channels, products, torch.from_numpy(away))
