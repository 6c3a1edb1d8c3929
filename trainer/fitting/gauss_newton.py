"""Fits of effects to captures: damped Gauss-Newton on the very error that is reported.

Columns of the Jacobian are secants one small physical step wide. They cost one prediction from the effect's own
stage on, whatever the effect does inside, and an iris edge or a laser line, whose derivative is zero or jumps where
the effect is absent, has a good one. What the fit minimises is the squared error in counts, unweighted: the reported
excess. The gain of each colour is always fitted along.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from trainer.captures.batches import Batch
from trainer.effects.definition import STAGES, Effect
from trainer.effects.starts import Evidence
from trainer.fitting.excess import Errors, errors_of, join
from trainer.model.model import Model, Present, Values, absent, raised
from trainer.prediction.predict import Trace, counts, light_on_camera, trace
from trainer.prediction.scene import Scene, Stages, scene_for, stages_of

STEP = 0.1  # of a parameter's scale: large against single precision's rounding, small against curvature


@dataclass(frozen=True)
class Fitted:
    """A fitted model with its error on the captures it saw, and the covariance of what was fitted."""

    model: Model
    errors: Errors
    covariance: np.ndarray
    keys: tuple[tuple[str, str, int], ...]  # (effect, parameter, index into its values)


class Predictor:
    """Predictions of one batch under changing models, each from the first stage that changed."""

    def __init__(self, model: Model, batch: Batch) -> None:
        self.scene: Scene = scene_for(model, batch.channel, batch.plane_mm, batch.signal.dtype)
        self.batch = batch

    def stages(self, model: Model) -> Stages:
        """The scene's stages under a model."""
        return stages_of(self.scene, model)

    def trace(self, model: Model, start: str = "drive", before: Trace | None = None) -> Trace:
        """Spectrum and irradiance from stage `start` on, a capture at a time to stay in the processor's cache."""
        if before is not None and start == "sensor":
            return before
        stages = self.stages(model)
        parts = []
        for k in range(self.batch.gray.shape[0]):
            one = None if before is None else Trace(before.spectrum[k : k + 1], before.image[k : k + 1])
            parts.append(trace(self.scene, stages, self.batch.gray[k : k + 1], start, one))
        return Trace(torch.cat([p.spectrum for p in parts]), torch.cat([p.image for p in parts]))

    def light(self, model: Model, point: Trace) -> Tensor:
        """Irradiance on the camera [B, h, w]."""
        return light_on_camera(self.scene, self.stages(model), point.image)

    def counts(self, model: Model, light: Tensor) -> Tensor:
        """Counts above black [B, h, w]."""
        gain = model.gain[self.batch.channel] * self.batch.exposure[:, None, None]
        measured = (self.batch.signal, self.batch.weight)
        return counts(self.scene, self.stages(model), light, gain, measured)

    def predict(self, model: Model, start: str = "drive", before: Trace | None = None) -> Tensor:
        """Counts above black [B, h, w], from stage `start` on."""
        return self.counts(model, self.light(model, self.trace(model, start, before)))


def with_gain(model: Model, predictors: Sequence[Predictor], points: Sequence[Trace] | None = None) -> Model:
    """The model with each colour's gain by least squares, other parameters as they are."""
    sums: dict[str, list[float]] = {}
    for k, predictor in enumerate(predictors):
        batch = predictor.batch
        unit = replace(model, gain={batch.channel: 1.0})
        stages = predictor.stages(unit)
        linear = replace(stages.sensor, offset=None, response=None, free_capture_gain=False)
        point = predictor.trace(unit) if points is None else points[k]
        light = light_on_camera(predictor.scene, stages, point.image)
        one = counts(
            predictor.scene, replace(stages, sensor=linear), light, batch.exposure[:, None, None], None
        )
        seen = batch.signal if stages.sensor.offset is None else batch.signal - stages.sensor.offset
        total = sums.setdefault(batch.channel, [0.0, 0.0])
        total[0] += float((batch.weight * seen * one).sum(dtype=torch.float64))
        total[1] += float((batch.weight * one**2).sum(dtype=torch.float64))
    gain = {**model.gain, **{c: max(a, 1e-12) / max(b, 1e-30) for c, (a, b) in sums.items()}}
    return replace(model, gain=gain)


def evaluate(model: Model, batches: Sequence[Batch]) -> Errors:
    """Errors of a model, with the gains it has, on batches."""
    with torch.no_grad():
        return join([errors_of(b, Predictor(model, b).predict(model)) for b in batches])


def start_points(effect: Effect, model: Model) -> list[Present]:
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
    model: Model, predictors: Sequence[Predictor], points: Sequence[Trace], start: Present
) -> Present:
    """A better start by coordinate steps of shrinking size: for effects whose derivatives do not reach far.

    The edge of an iris is one: its derivative sees one frequency sample, and the next one is unrelated.
    """
    best, least = start, start_cost(model, predictors, points, start)
    for factor in (6.0, 3.0, 1.5, 0.75, 0.35, 0.15):
        improved = True
        while improved:
            improved = False
            for key in keys_of(model.having(best), [best.effect.name]):
                for sign in (-1, 1):
                    step = sign * factor * best.effect.parameter(key[1]).scale
                    trial = _present(stepped(model.having(best), key, step), best.effect.name)
                    cost = start_cost(model, predictors, points, trial)
                    if cost < 0.9999 * least:
                        best, least, improved = trial, cost, True
    return best


def start_cost(
    model: Model, predictors: Sequence[Predictor], points: Sequence[Trace], start: Present
) -> float:
    """Squared error of a model with an effect at a start, gains fitted."""
    trial = model.having(start)
    moved = [p.trace(trial, start.effect.stage, t) for p, t in zip(predictors, points, strict=True)]
    trial = with_gain(trial, predictors, moved)
    return sum(_cost(p, p.counts(trial, p.light(trial, t))) for p, t in zip(predictors, moved, strict=True))


def _cost(predictor: Predictor, prediction: Tensor) -> float:
    batch = predictor.batch
    return float((batch.weight * (batch.signal - prediction) ** 2).sum(dtype=torch.float64))


def fit(
    model: Model,
    free: Sequence[str],
    batches: Sequence[Batch],
    iterations: int = 12,
    tolerance: float = 1e-3,
    progress: Callable[[float], None] | None = None,
) -> Fitted:
    """Fit the named effects of a model, and the gains, to batches.

    Stops after `iterations`, or when a step lowers the excess by less than `tolerance` of it and less than 2e-6.
    Errors are standard errors from the residuals themselves (a sandwich), so misfit widens them.
    """
    with torch.no_grad():
        return _fit(model, tuple(free), batches, iterations, tolerance, progress)


def _fit(
    model: Model,
    free: tuple[str, ...],
    batches: Sequence[Batch],
    iterations: int,
    tolerance: float,
    progress: Callable[[float], None] | None,
) -> Fitted:
    predictors = [Predictor(model, b) for b in batches]
    keys = keys_of(model, free)
    first = min((_present(model, n).effect.stage for n in free), key=STAGES.index, default="sensor")
    points = [p.trace(model) for p in predictors]
    if not model.gain or any(b.channel not in model.gain for b in batches):
        model = with_gain(model, predictors, points)
    channels = list(dict.fromkeys(b.channel for b in batches))
    slopes = slopes_of(model, keys, channels, predictors, points)
    residuals, errors = weighted_residuals(model, predictors, points)
    damping, fresh = 1e-3, True
    for iteration in range(iterations):
        if progress:
            progress(iteration / iterations)
        before = errors.excess
        normal, gradient = _normal(slopes), _gradient(slopes, residuals)
        accepted = False
        for _ in range(6 if fresh else 1):
            trial = _moved(model, keys, channels, _solve(normal, gradient, damping))
            trial_points = [p.trace(trial, first, t) for p, t in zip(predictors, points, strict=True)]
            trial_residuals, trial_errors = weighted_residuals(trial, predictors, trial_points)
            if trial_errors.excess < before:
                accepted = True
                break
            damping = max(damping, 1e-4) * 8
        if accepted:
            model, points = trial, trial_points
            residuals, errors = trial_residuals, trial_errors
            damping = max(damping / 10, 1e-7)
        elif fresh:
            break
        gone = before - errors.excess
        if fresh and gone < max(tolerance * abs(errors.excess), 2e-6):
            break
        # Secants are dear: they serve again while a step still takes more than half of what is left.
        fresh = not gone > 0.5 * before
        if fresh and iteration + 1 < iterations:
            slopes = slopes_of(model, keys, channels, predictors, points)
    normal, scatter = _normal(slopes), _scatter(slopes, residuals)
    model = _measured(model, free, batches)
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    covariance = inverse @ scatter @ inverse
    return Fitted(_with_errors(model, keys, covariance), errors, covariance, keys)


def _measured(model: Model, free: Sequence[str], batches: Sequence[Batch]) -> Model:
    """The model with the values that effects read off the captures rather than fit."""
    for name in free:
        present = _present(model, name)
        if present.effect.measure is None:
            continue
        without = replace(model, present=tuple(p for p in model.present if p.effect.name != name))
        evidence = [
            Evidence(p.scene, p.batch, p.predict(without)) for p in (Predictor(without, b) for b in batches)
        ]
        read = present.effect.measure(evidence)
        values = {n: np.full_like(v, read[n]) if n in read else v for n, v in present.values.items()}
        model = model.having(replace(present, values=values))
    return model


def _present(model: Model, name: str) -> Present:
    return next(p for p in model.present if p.effect.name == name)


def keys_of(model: Model, free: Sequence[str]) -> tuple[tuple[str, str, int], ...]:
    keys = []
    for name in free:
        present = _present(model, name)
        for p in present.effect.parameters:
            keys += [(name, p.name, i) for i in range(present.values[p.name].size)]
    return tuple(keys)


def stepped(model: Model, key: tuple[str, str, int], change: float) -> Model:
    """The model with one number of one effect changed, held within its physical range."""
    name, parameter, index = key
    present = _present(model, name)
    p = present.effect.parameter(parameter)
    values = np.array(present.values[parameter], dtype=float)
    flat = values.reshape(-1)
    flat[index] = min(max(flat[index] + change, p.low), p.high)
    return model.having(replace(present, values={**present.values, parameter: values}))


def column_step(model: Model, key: tuple[str, str, int]) -> float:
    """Width of the secant that stands for a derivative: towards the inside of the range."""
    present = _present(model, key[0])
    p = present.effect.parameter(key[1])
    value = float(present.values[key[1]].reshape(-1)[key[2]])
    step = p.scale * (1.0 if p.even and value < p.scale else STEP)
    return -step if value + step > p.high else step


def columns(
    model: Model, keys: Sequence[tuple[str, str, int]], predictor: Predictor, point: Trace
) -> tuple[Tensor, list[Tensor]]:
    """Prediction [B, h, w] and its change a unit of each parameter, then of the logarithm of the gain."""
    light = predictor.light(model, point)
    base = predictor.counts(model, light)
    result = []
    for key in keys:
        step = column_step(model, key)
        stage = _present(model, key[0]).effect.stage
        moved = predictor.predict(stepped(model, key, step), stage, point)
        result.append((moved - base) / step)
    louder = replace(model, gain={c: g * 1.01 for c, g in model.gain.items()})
    result.append((predictor.counts(louder, light) - base) / 0.01)
    return base, result


def slopes_of(
    model: Model,
    keys: tuple[tuple[str, str, int], ...],
    channels: list[str],
    predictors: Sequence[Predictor],
    points: Sequence[Trace],
) -> list[Tensor]:
    """Weighted derivatives of each batch's prediction: [keys + channels, pixels]."""
    blocks = []
    for predictor, point in zip(predictors, points, strict=True):
        weight = predictor.batch.weight
        block = torch.zeros((len(keys) + len(channels), weight.numel()), dtype=weight.dtype)
        _, slopes = columns(model, keys, predictor, point)
        which = [*range(len(keys)), len(keys) + channels.index(predictor.batch.channel)]
        for row, slope in zip(which, slopes, strict=True):
            block[row] = (weight * slope).reshape(-1)
        blocks.append(block)
    return blocks


def weighted_residuals(
    model: Model, predictors: Sequence[Predictor], points: Sequence[Trace]
) -> tuple[list[Tensor], Errors]:
    """Weighted residuals of each batch [pixels], and the errors they make."""
    residuals, errors = [], []
    for predictor, point in zip(predictors, points, strict=True):
        batch = predictor.batch
        prediction = predictor.counts(model, predictor.light(model, point))
        residuals.append((batch.weight * (batch.signal - prediction)).reshape(-1))
        errors.append(errors_of(batch, prediction))
    return residuals, join(errors)


def _normal(slopes: list[Tensor]) -> np.ndarray:
    return sum((s @ s.T).double().numpy() for s in slopes)  # type: ignore[return-value]


def _gradient(slopes: list[Tensor], residuals: list[Tensor]) -> np.ndarray:
    return sum((s @ r).double().numpy() for s, r in zip(slopes, residuals, strict=True))  # type: ignore[return-value]


def _scatter(slopes: list[Tensor], residuals: list[Tensor]) -> np.ndarray:
    weighted = [s * r for s, r in zip(slopes, residuals, strict=True)]
    return sum((w @ w.T).double().numpy() for w in weighted)  # type: ignore[return-value]


def _solve(normal: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    diagonal = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    scaled = normal / np.outer(diagonal, diagonal)
    scaled[np.diag_indices_from(scaled)] += damping + 1e-9
    return np.linalg.solve(scaled, gradient / diagonal) / diagonal


def _moved(
    model: Model, keys: tuple[tuple[str, str, int], ...], channels: list[str], step: np.ndarray
) -> Model:
    for key, change in zip(keys, step, strict=False):
        model = stepped(model, key, float(change))
    logs = dict(zip(channels, step[len(keys) :], strict=False))
    gain = {c: g * float(np.exp(np.clip(logs.get(c, 0.0), -1, 1))) for c, g in model.gain.items()}
    return replace(model, gain=gain)


def _with_errors(model: Model, keys: tuple[tuple[str, str, int], ...], covariance: np.ndarray) -> Model:
    spread = np.sqrt(np.maximum(np.diag(covariance), 0))
    for name in dict.fromkeys(k[0] for k in keys):
        present = _present(model, name)
        errors: Values = {n: np.zeros_like(v) for n, v in present.values.items()}
        for i, (effect_name, parameter, index) in enumerate(keys):
            if effect_name == name:
                errors[parameter].reshape(-1)[index] = spread[i]
        model = model.having(replace(present, errors=errors))
    return model


def raise_order(
    fitted: Fitted,
    name: str,
    batches: Sequence[Batch],
    gain_needed: Callable[[float], float],
    free: Sequence[str] | None = None,
) -> Fitted:
    """Raise the order of an effect's map or curve while the error keeps falling.

    `gain_needed(excess)` is how much excess a higher order must remove to be kept; `free` are the effects that are
    refitted along, the effect alone by default.
    """
    while True:
        present = _present(fitted.model, name)
        higher = [o for o in present.effect.orders if o > present.order]
        if not higher:
            return fitted
        trial = fitted.model.having(raised(present, fitted.model.bench, higher[0]))
        better = fit(trial, free or [name], batches, iterations=8)
        if fitted.errors.excess - better.errors.excess < gain_needed(fitted.errors.excess):
            return fitted
        fitted = better
