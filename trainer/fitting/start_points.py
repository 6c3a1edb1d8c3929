"""Where a fit of an effect starts: its declared starting points, and a search by steps of shrinking size."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from trainer.effects.definition import Effect
from trainer.fitting.jacobian import keys_of, stepped
from trainer.fitting.least_squares_gain import with_gain
from trainer.fitting.predictor import Predictor, lights_of
from trainer.model.model import EffectInstance, Model, absent
from trainer.prediction.predict import Trace


def start_points(effect: Effect, model: Model) -> list[EffectInstance]:
    """Where a fit of an effect starts: absent, and every combination of its parameters' own starting values."""
    base = absent(effect, model.bench)
    choices = [
        [(p.name, s) for s in (p.starts or ((p.scale,) if p.even else (p.absent_value(model.bench),)))]
        for p in effect.parameters
    ]
    return [
        base.with_values({n: np.full_like(base.values[n], s) for n, s in combination})
        for combination in itertools.product(*choices)
    ]


def pattern_search(
    model: Model, predictors: Sequence[Predictor], points: Sequence[Trace], start: EffectInstance
) -> EffectInstance:
    """A better start by coordinate steps of shrinking size: for effects whose derivatives do not reach far.

    The edge of an iris is one: its derivative sees one frequency sample, and the next one is unrelated.
    """
    known: dict[bytes, float] = {}  # steps lead back, and end at the ends of a range

    def cost_of(there: EffectInstance) -> float:
        place = b"".join(values.tobytes() for values in there.values.values())
        if place not in known:
            known[place] = start_cost(model, predictors, points, there)
        return known[place]

    best, least = start, cost_of(start)
    for factor in (6.0, 3.0, 1.5, 0.75):  # from there on the fit itself is quicker
        improved = True
        while improved:
            improved = False
            for key in keys_of(model.having(best), [best.effect.name]):
                for sign in (-1, 1):
                    step = sign * factor * best.effect.parameter(key[1]).scale
                    trial = stepped(model.having(best), key, step).instance(best.effect.name)
                    cost = cost_of(trial)
                    if cost < 0.999 * least:
                        best, least, improved = trial, cost, True
    return best


def start_cost(
    model: Model,
    predictors: Sequence[Predictor],
    points: Sequence[Trace],
    start: EffectInstance,
    nearby: bool = False,
) -> float:
    """Squared error of a model with an effect at a start, gains fitted; the captures move about as without it.

    Parameters
    ----------
    nearby : bool
        As for `Predictor.trace`: the start is taken for a small step from the model of `points`.
    """
    trial = model.having(start)
    near = [p.motions(model, t) for p, t in zip(predictors, points, strict=True)]
    moved = [p.trace(trial, start.effect.stage, t, nearby) for p, t in zip(predictors, points, strict=True)]
    lights = lights_of(trial, predictors, moved, near)
    trial = with_gain(trial, predictors, lights)
    return sum(_cost(p, p.counts(trial, light)) for p, light in zip(predictors, lights, strict=True))


def _cost(predictor: Predictor, prediction: Tensor) -> float:
    batch = predictor.batch
    return float((batch.mask * (batch.signal - prediction) ** 2).sum(dtype=torch.float64))
