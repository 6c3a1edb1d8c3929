"""The gain of each colour: camera counts a unit of irradiance and millisecond, by least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from trainer.fitting.predictor import Predictor
from trainer.model.model import Model
from trainer.prediction.predict import counts


def with_gain(model: Model, predictors: Sequence[Predictor], lights: Sequence[Tensor] | None = None) -> Model:
    """The model with each colour's gain by least squares, other parameters as they are.

    Parameters
    ----------
    lights : sequence of Tensor [B, h, w], optional
        Irradiance on the camera of each predictor's batch under the model; computed where not given.
    """
    sums: dict[str, list[float]] = {}
    for k, predictor in enumerate(predictors):
        batch = predictor.batch
        unit = replace(model, gain={batch.channel: 1.0})
        light = predictor.light(unit, predictor.trace(unit)) if lights is None else lights[k]
        exposed = batch.exposure[:, None, None]
        ones, signals = [], []
        for part, stages in predictor.parts(unit):
            linear = replace(stages.sensor, offset=None, response=None, free_capture_gain=False)
            plain = replace(stages, sensor=linear)
            ones.append(counts(predictor.scene, plain, light[part], exposed[part], None))
            signal, added = batch.signal[part], stages.sensor.offset
            signals.append(signal if added is None else signal - added)
        one, light_counts = batch.as_compared(torch.cat(ones)), torch.cat(signals)
        total = sums.setdefault(batch.channel, [0.0, 0.0])
        total[0] += float((batch.mask * light_counts * one).sum(dtype=torch.float64))
        total[1] += float((batch.mask * one**2).sum(dtype=torch.float64))
    gain = {**model.gain, **{c: max(a, 1e-12) / max(b, 1e-30) for c, (a, b) in sums.items()}}
    return replace(model, gain=gain)
