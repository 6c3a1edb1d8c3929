"""Trying effects on a model: a quick screen of all, and real fits of some. Each is a task that any process can run.

The screen is a score test: how much of the residual lies in the span of the effect's derivative at "absent" (or at
the best of its starting points, where the derivative at absent does not reach), with the gains and the parameters of
all present effects projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trainer.captures.batches import Batch, load, load_batch
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import Capture, CaptureSet, read_captures
from trainer.effects.definition import Effect
from trainer.effects.starts import Evidence
from trainer.fitting.excess import Errors, errors_of, join
from trainer.fitting.gauss_newton import (
    Fitted,
    Predictor,
    fit,
    keys_of,
    pattern_search,
    raise_order,
    slopes_of,
    start_cost,
    start_points,
    weighted_residuals,
    with_gain,
)
from trainer.model.model import Model, Present, absent
from trainer.prediction.predict import Trace


@dataclass(frozen=True)
class Screened:
    """What the screen expects of an effect: the excess that would remain, and where a fit should start."""

    effect: str
    start: Present
    before: float
    after: float

    @property
    def removed(self) -> float:
        """Excess expected to go, on the captures that the screen saw."""
        return self.before - self.after


@dataclass(frozen=True)
class Tried:
    """A fitted candidate: the model with it, and its held-out errors."""

    effect: str
    model: Model
    fitted_excess: float
    held_out: Errors


def opened(folder: Path) -> CaptureSet:
    """The capture set of a folder, read once a process, and again when its tables have changed."""
    return _opened(folder, *((folder / name).stat().st_mtime_ns for name in ("bench.toml", "captures.csv")))


@lru_cache(maxsize=4)
def _opened(folder: Path, *changed: int) -> CaptureSet:
    return read_captures(folder)


def chosen(captures: CaptureSet, ids: Sequence[str]) -> list[Capture]:
    """Captures by id, in the order of the set."""
    wanted = set(ids)
    return [c for c in captures.captures if c.capture in wanted]


def evaluate_captures(captures: CaptureSet, rows: Sequence[Capture], model: Model) -> Errors:
    """Errors of a model on captures, one in memory at a time."""
    with torch.no_grad():
        parts = []
        for row in rows:
            batch = load_batch(captures, [row])
            parts.append(errors_of(batch, Predictor(model, batch).predict(model)))
        return join(parts)


def screen(folder: Path, ids: tuple[str, ...], model: Model, effects: tuple[Effect, ...]) -> list[Screened]:
    """Screen effects on some captures, for a model with fitted gains."""
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    with torch.no_grad():
        return screen_batches(batches, model, effects)


def screen_batches(batches: list[Batch], model: Model, effects: tuple[Effect, ...]) -> list[Screened]:
    results = []
    known: dict[bool, tuple[list[Predictor], list[Trace], Tensor, Tensor]] = {}
    for effect in effects:
        wide = effect.touches_iris
        if wide not in known:
            reach = model if not wide else model.having(absent(effect, model.bench))
            predictors = [Predictor(reach, b) for b in batches]
            points = [p.trace(model) for p in predictors]
            nuisance = _stacked(model, keys_of(model, model.names), predictors, points)
            known[wide] = (predictors, points, *nuisance)
        predictors, points, residual, present = known[wide]
        noise = sum(float((b.weight * b.noise).sum()) for b in batches)
        scale = float(join([errors_of(b, torch.zeros_like(b.signal)) for b in batches]).variance.sum())
        before = (_remaining(residual, present) - noise) / scale
        start = _start(effect, model, predictors, points)
        trial = model.having(start)
        moved = [p.trace(trial, effect.stage, t) for p, t in zip(predictors, points, strict=True)]
        trial = with_gain(trial, predictors, moved)
        residual_there, slopes = _stacked(trial, keys_of(trial, [effect.name]), predictors, moved)
        after = (_remaining(residual_there, torch.cat([slopes, present])) - noise) / scale
        results.append(Screened(effect.name, start, before, after))
    return results


def _start(effect: Effect, model: Model, predictors: list[Predictor], points: list[Trace]) -> Present:
    starts = start_points(effect, model)
    if effect.starts is not None:
        evidence = []
        for predictor, point in zip(predictors, points, strict=True):
            prediction = predictor.counts(model, predictor.light(model, point))
            evidence.append(Evidence(predictor.scene, predictor.batch, prediction))
        starts += [placed(effect, model.bench, values) for values in effect.starts(evidence)]
    if len(starts) == 1:
        return starts[0]
    # A start need only be near: one colour and plane tell.
    few, there = predictors[:1], points[:1]
    costs = [start_cost(model, few, there, start) for start in starts]
    if max(costs) - min(costs) < 1e-9 * max(costs):
        # A period or a place says nothing while the amplitude is zero: look one step ahead.
        costs = [_one_step_ahead(model, few, there, start) for start in starts]
    return starts[costs.index(min(costs))]


def placed(effect: Effect, bench: Bench, values: dict[str, Any]) -> Present:
    """The effect with some values given, held within their physical range, and the others absent."""
    base = absent(effect, bench)
    full = dict(base.values)
    for name, value in values.items():
        p = effect.parameter(name)
        full[name] = np.array(np.clip(value, p.low, p.high), dtype=float).reshape(base.values[name].shape)
    return base.with_values(full)


def _one_step_ahead(model: Model, predictors: list[Predictor], points: list[Trace], start: Present) -> float:
    """Squared error that a straight-line step from a start would leave."""
    trial = model.having(start)
    return _remaining(*_stacked(trial, keys_of(trial, [start.effect.name]), predictors, points))


def _stacked(
    model: Model, keys: tuple[tuple[str, str, int], ...], predictors: list[Predictor], points: list[Trace]
) -> tuple[Tensor, Tensor]:
    """Weighted residual [pixels] and derivatives [keys + colours, pixels] over all batches."""
    channels = list(dict.fromkeys(p.batch.channel for p in predictors))
    residuals, _ = weighted_residuals(model, predictors, points)
    return torch.cat(residuals), torch.cat(slopes_of(model, keys, channels, predictors, points), dim=1)


def _remaining(residual: Tensor, slopes: Tensor) -> float:
    """Sum of squares of the residual outside the span of the columns."""
    norms = torch.linalg.vector_norm(slopes, dim=1, dtype=torch.float64)
    slopes = slopes[norms > 1e-9 * float(norms.max() + 1e-30)]
    norms = norms[norms > 1e-9 * float(norms.max() + 1e-30)]
    total = float((residual.double() ** 2).sum())
    if not len(norms):
        return total
    normal = (slopes @ slopes.T).double() / torch.outer(norms, norms)
    along = (slopes @ residual).double() / norms
    normal += 1e-6 * torch.eye(len(norms), dtype=torch.float64)
    return total - float(along @ torch.linalg.solve(normal, along))


def try_effect(
    folder: Path,
    ids: tuple[str, ...],
    held_ids: tuple[str, ...],
    model: Model,
    start: Present,
    raising: bool,
    iterations: int = 8,
) -> Tried:
    """Fit one effect, with present ones as they are, and judge it on held-out captures."""
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    name = start.effect.name
    fitted = fit_from(model, start, batches, iterations)
    if raising:
        fitted = raise_order(fitted, name, batches, least_for_order)
    return _judged(name, fitted, captures, held_ids)


def try_together(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, name: str
) -> Tried:
    """Fit all effects of a model together, and judge it on held-out captures as an explanation by effect `name`."""
    captures = opened(folder)
    return _judged(name, settled(model, load(captures, chosen(captures, ids))), captures, held_ids)


def _judged(name: str, fitted: Fitted, captures: CaptureSet, held_ids: tuple[str, ...]) -> Tried:
    held_out = evaluate_captures(captures, chosen(captures, held_ids), fitted.model)
    return Tried(name, fitted.model, fitted.errors.excess, held_out)


def settled(model: Model, batches: Sequence[Batch]) -> Fitted:
    """The model with all of its effects fitted together, and their orders raised as far as that helps."""
    fitted = fit(model, model.names, batches)
    for name in model.names:
        fitted = raise_order(fitted, name, batches, least_for_order, model.names)
    return fitted


def fit_from(model: Model, start: Present, batches: Sequence[Batch], iterations: int = 12) -> Fitted:
    """Fit one effect from a start; where derivatives do not reach far, after a pattern search."""
    if start.effect.rugged:
        with torch.no_grad():
            predictors = [Predictor(model.having(start), b) for b in batches[:3]]
            points = [p.trace(model) for p in predictors]
            start = pattern_search(model, predictors, points, start)
    return fit(model.having(start), [start.effect.name], batches, iterations)


def least_for_order(excess: float) -> float:
    """Excess that a higher order must remove: a twentieth of what is left, and more than what noise can."""
    return max(0.05 * excess, 1e-5)
