"""The gain of each colour: camera counts a unit of irradiance and millisecond, by least squares."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from trainer.fitting.predictor import Predictor
from trainer.model.model import Model
from trainer.prediction.camera_light import counts
from trainer.prediction.capture_gain import SETTLED, STEPS, brightness_step, brightness_terms


def with_gain(model: Model, predictors: Sequence[Predictor], lights: Sequence[Tensor] | None = None) -> Model:
    """The model with each colour's gain by least squares, other parameters as they are.

    Parameters
    ----------
    lights : sequence of Tensor [B, h, w], optional
        Irradiance on the camera of each predictor's batch under the model; computed where not given.
    """
    sums: dict[str, list[float]] = {}
    bent: list[tuple[Predictor, Tensor]] = []
    for k, predictor in enumerate(predictors):
        batch = predictor.batch
        unit = replace(model, gain={batch.channel: 1.0})
        light = predictor.light(unit, predictor.trace(unit)) if lights is None else lights[k]
        exposed = batch.exposure[:, None, None]
        ones, signals = [], []
        parts = predictor.parts(unit)
        if any(stages.sensor.response is not None for _, stages in parts):
            bent.append((predictor, light))
        for part, stages in parts:
            linear = replace(stages.sensor, offset=None, response=None, free_capture_gain=False)
            plain = replace(stages, sensor=linear)
            ones.append(counts(predictor.scene, plain, light[part], exposed[part], None))
            signal, added = batch.signal[part], stages.sensor.added
            signals.append(signal if added is None else signal - added)
        one, light_counts = batch.as_compared(torch.cat(ones)), torch.cat(signals)
        total = sums.setdefault(batch.channel, [0.0, 0.0])
        total[0] += float((batch.mask * light_counts * one).sum(dtype=torch.float64))
        total[1] += float((batch.mask * one**2).sum(dtype=torch.float64))
    gain = {**model.gain, **{c: max(a, 1e-12) / max(b, 1e-30) for c, (a, b) in sums.items()}}
    model = replace(model, gain=gain)
    return _through_response(model, bent) if bent else model


def _through_response(model: Model, lit: Sequence[tuple[Predictor, Tensor]]) -> Model:
    """The model with the gains of batches whose counts are not proportional to light, from its own gains on."""
    for _ in range(STEPS):
        sums: dict[str, Tensor] = {}
        for predictor, light in lit:
            batch = predictor.batch
            terms = brightness_terms(_counts_of(model, predictor, light), batch.signal, batch.mask)
            both = torch.stack([t.sum(dtype=torch.float64) for t in terms])
            sums[batch.channel] = sums[batch.channel] + both if batch.channel in sums else both
        changes = {c: float(brightness_step(along, power)) for c, (along, power) in sums.items()}
        gain = {**model.gain, **{c: model.gain[c] * math.exp(change) for c, change in changes.items()}}
        model = replace(model, gain=gain)
        if max(abs(change) for change in changes.values()) < SETTLED:
            break
    return model


def _counts_of(model: Model, predictor: Predictor, light: Tensor) -> Callable[[float], Tensor]:
    """Counts of a batch at so many times the light, without a gain of each capture's own."""
    batch = predictor.batch
    gain = predictor.gain(model)

    def found(factor: float) -> Tensor:
        parts = []
        for part, stages in predictor.parts(model):
            steady = replace(stages, sensor=replace(stages.sensor, free_capture_gain=False))
            parts.append(counts(predictor.scene, steady, light[part], factor * gain[part], None))
        return batch.as_compared(torch.cat(parts))

    return found
