"""Derivatives of predictions with respect to the numbers of effects, as secants one small physical step wide.

Tables of derivatives, and the residuals that go with them, are of every pixel of small pictures and of evenly chosen
ones of large pictures: two million pixels of each capture would fill the memory, and a seventh of them says enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from runtime.excess import PredictionErrors, joined
from trainer.captures.batches import Batch
from trainer.fitting.predictor import Predictor
from trainer.fitting.side_by_side import side_by_side
from trainer.model.model import Model
from trainer.prediction.predict import Trace

NO_CHANGE = 1e-5  # of the prediction: what a number's scale must change for captures to determine it
STEP = 0.1  # of a parameter's scale: large against single precision's rounding, small against curvature
GAIN_REACH = 1.0  # largest step of a gain's logarithm
LOUDER = 0.01  # change of the light's logarithm: its secant is the derivative by a gain
ROUNDING = 1e-7  # of the largest eigenvalue of a normal matrix, whose sums are of single precision
TABLE_PIXELS = 1 << 19  # most pixels of a capture in a table of derivatives

Key = tuple[str, str, int]  # of a number: effect, parameter, index into its values


def weighted(batch: Batch, counts: Tensor) -> Tensor:
    """Counts [B, h, w] of a batch as rows of tables have them: [pixels].

    Those that can be used, of the pixels that tables are of. Each stands for as many as were left out, so that sums of
    squares are those of all pixels.
    """
    every = _every(batch)
    chosen = (batch.mask * counts).reshape(-1)[::every]
    return chosen if every == 1 else math.sqrt(every) * chosen


def unweighted(batch: Batch, row: Tensor) -> Tensor:
    """The adjoint of `weighted`: [B, h, w] from a row [pixels]."""
    every = _every(batch)
    spread = torch.zeros(batch.mask.numel(), dtype=row.dtype)
    spread[::every] = math.sqrt(every) * row
    return batch.mask * spread.reshape(batch.mask.shape)


def _every(batch: Batch) -> int:
    """One of so many pixels, row after row, is in a table: a number that lets all columns have their turn."""
    height, width = batch.mask.shape[-2:]
    every = math.ceil(height * width / TABLE_PIXELS)
    while math.gcd(every, width) > 1:
        every += 1
    return every


def keys_of(model: Model, free: Sequence[str]) -> tuple[Key, ...]:
    """Keys (effect, parameter, index into its values) of every number of the named effects."""
    keys = []
    for name in free:
        present = model.instance(name)
        for p in present.effect.parameters:
            if p.per_pixel:
                continue
            keys += [(name, p.name, i) for i in range(present.values[p.name].size)]
    return tuple(keys)


def stepped(model: Model, key: Key, change: float) -> Model:
    """The model with one number of one effect changed, held within its physical range."""
    name, parameter, index = key
    present = model.instance(name)
    p = present.effect.parameter(parameter)
    values = np.array(present.values[parameter], dtype=float)
    flat = values.reshape(-1)
    flat[index] = min(max(flat[index] + change, p.low), p.high)
    return model.having(replace(present, values={**present.values, parameter: values}))


def moved(model: Model, keys: Sequence[Key], channels: Sequence[str], step: np.ndarray) -> Model:
    """The model after a step of numbers, in their physical units, and then of the logarithms of the colours' gains."""
    for key, change in zip(keys, step, strict=False):
        model = stepped(model, key, float(change))
    logs = dict(zip(channels, step[len(keys) :], strict=False))
    gain = {
        c: g * float(np.exp(np.clip(logs.get(c, 0.0), -GAIN_REACH, GAIN_REACH)))
        for c, g in model.gain.items()
    }
    return replace(model, gain=gain)


def colour_of(model: Model, key: Key) -> str | None:
    """The colour whose own a number is; None where colours have it in common."""
    name, parameter, index = key
    present = model.instance(name)
    if not present.effect.parameter(parameter).per_channel:
        return None
    rows = len(model.bench.channels)
    return model.bench.channels[index // (present.values[parameter].size // rows)].name


def away_from_absent(model: Model, key: Key) -> float:
    """How far one number of one effect is from its value where the effect is not there; physical units."""
    name, parameter, index = key
    present = model.instance(name)
    absent = present.effect.parameter(parameter).absent_value(model.bench)
    return float(present.values[parameter].reshape(-1)[index]) - absent


def column_step(model: Model, key: Key) -> float:
    """Step of the secant for one number, towards the inside of its range; physical units."""
    present = model.instance(key[0])
    p = present.effect.parameter(key[1])
    value = float(present.values[key[1]].reshape(-1)[key[2]])
    step = p.scale * (1.0 if p.even and value < p.scale else STEP)
    return -step if value + step > p.high else step


def columns(
    model: Model,
    keys: Sequence[Key],
    predictor: Predictor,
    point: Trace,
    kept: Callable[[Tensor], Tensor] = lambda slope: slope,
) -> tuple[Tensor, list[Tensor]]:
    """Prediction of a batch and its derivatives.

    Where each capture has its own gain, the gain is held while a number moves, and then follows as a straight line:
    variable projection as Kaufman (1975) simplified it. To find it anew in every column costs more than all the rest
    behind a bent response.

    Parameters
    ----------
    point : Trace
        The batch's light under `model`.
    kept : callable
        What is kept of each derivative [B, h, w]; without it, all.

    Returns
    -------
    tensor [B, h, w], counts
    list of tensors [B, h, w], or what is kept of them
        Change a unit of each parameter, then of the logarithm of the gain. Zero for another colour's number, for one
        that changes nothing here, where the difference would be rounding alone, and for the gain where each capture
        has its own.
    """
    near = predictor.motions(model, point)
    light = predictor.light(model, point, near)
    own = predictor.own_gains(model, light)
    base = predictor.counts(model, light, own)
    least = NO_CHANGE * float(torch.linalg.vector_norm(base))
    by_own = None if own is None else predictor.counts(model, light, math.exp(LOUDER) * own) - base

    def slope(moved: Tensor, step: float, scale: float) -> Tensor:
        found = (moved - base) / step
        if by_own is not None:
            found = _without(found, by_own, predictor.batch.mask)
        shows = scale * float(torch.linalg.vector_norm(found)) > least
        return kept(found if shows else torch.zeros_like(found))

    def of_number(key: Key) -> Tensor:
        if colour_of(model, key) not in (None, predictor.batch.channel):
            return kept(torch.zeros_like(base))
        step, effect = column_step(model, key), model.instance(key[0]).effect
        moved = predictor.predict_nearby(stepped(model, key, step), effect.stage, point, near, own)
        return slope(moved, step, effect.parameter(key[1]).scale)

    result = side_by_side(of_number, keys, max(base[0].numel(), predictor.batch.gray[0].numel()))
    if own is not None:
        result.append(kept(torch.zeros_like(base)))
    else:
        louder = replace(model, gain={c: g * math.exp(LOUDER) for c, g in model.gain.items()})
        result.append(slope(predictor.counts(louder, light), LOUDER, 1.0))
    return base, result


def _without(change: Tensor, other: Tensor, weight: Tensor) -> Tensor:
    """A change of each picture [B, h, w] without what so many times another change does in it."""
    power = (weight * other**2).sum((-2, -1), keepdim=True)
    along = (weight * other * change).sum((-2, -1), keepdim=True)
    return change - along / torch.where(power > 0, power, torch.ones_like(power)) * other


def slopes_of(
    model: Model,
    keys: tuple[Key, ...],
    channels: list[str],
    predictors: Sequence[Predictor],
    points: Sequence[Trace],
) -> list[Tensor]:
    """Weighted derivatives of each batch's prediction: [keys + channels, pixels]."""
    blocks = []
    for predictor, point in zip(predictors, points, strict=True):
        _, slopes = columns(model, keys, predictor, point, partial(weighted, predictor.batch))
        block = torch.zeros((len(keys) + len(channels), slopes[0].numel()), dtype=slopes[0].dtype)
        which = [*range(len(keys)), len(keys) + channels.index(predictor.batch.channel)]
        for row, slope in zip(which, slopes, strict=True):
            block[row] = slope
        blocks.append(block)
    return blocks


def follow(slopes: Sequence[Tensor], changes: Sequence[Tensor], step: np.ndarray) -> float:
    """Let derivatives [keys + colours, pixels] say of a step what it did (Broyden 1965, eq. 4.5), in place.

    Each number's by its part of what the step was expected to do: so derivatives near where the step began serve where
    it ended.

    Parameters
    ----------
    changes : sequence of Tensor [pixels]
        What the step did to each batch's prediction.
    step : array [keys + colours]

    Returns
    -------
    float
        Share of the squared change that was not expected.
    """
    unexpected, whole = 0.0, 0.0
    for table, change in zip(slopes, changes, strict=True):
        taken = torch.as_tensor(step, dtype=table.dtype)
        missed = change - taken @ table
        unexpected += float(missed @ missed)
        whole += float(change @ change)
        parts = torch.linalg.vector_norm(table, dim=1) ** 2 * taken  # 0 for what changes nothing here
        along = float(parts @ taken)
        if along > 0:
            table.addr_(parts / along, missed)
    return unexpected / whole if whole > 0 else 0.0


def weighted_residuals(
    model: Model, predictors: Sequence[Predictor], points: Sequence[Trace]
) -> tuple[list[Tensor], PredictionErrors]:
    """Weighted residuals of each batch [pixels], and the errors that all pixels make."""
    residuals, errors = [], []
    for predictor, point in zip(predictors, points, strict=True):
        batch = predictor.batch
        prediction = predictor.counts(model, predictor.light(model, point))
        residuals.append(weighted(batch, batch.signal - prediction))
        errors.append(batch.errors(prediction))
    return residuals, joined(errors)


def stacked(
    model: Model, keys: tuple[Key, ...], predictors: list[Predictor], points: list[Trace]
) -> tuple[Tensor, Tensor]:
    """Weighted residual [pixels] and derivatives [keys + colours, pixels] over all batches."""
    channels = list(dict.fromkeys(p.batch.channel for p in predictors))
    residuals, _ = weighted_residuals(model, predictors, points)
    return torch.cat(residuals), torch.cat(slopes_of(model, keys, channels, predictors, points), dim=1)


def remaining(residual: Tensor, slopes: Tensor) -> float:
    """Sum of squares of the residual outside the span of the columns."""
    total = float((residual.double() ** 2).sum())
    return outside_span(total, (slopes @ residual).double(), (slopes @ slopes.T).double())


def outside_span(total: float, along: Tensor, normal: Tensor) -> float:
    """Sum of squares outside the span of n columns.

    Parameters
    ----------
    total : float
        All of it.
    along, normal : Tensor [n], [n, n], float64
        Products of the columns with what is summed, and with each other.
    """
    norms = normal.diagonal().clamp(min=0).sqrt()
    shows = norms > 1e-9 * norms.max() if len(norms) else norms > 0
    if not bool(shows.any()):
        return total
    norms, along = norms[shows], along[shows] / norms[shows]
    normal = normal[shows][:, shows] / torch.outer(norms, norms) + 1e-6 * torch.eye(
        len(norms), dtype=torch.float64
    )
    return total - float(along @ torch.linalg.solve(normal, along))


def damped_step(normal: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    """Step of a least-squares problem, damped as Levenberg and Marquardt do: `damping` of each number's own square."""
    diagonal, scaled = _scaled(normal, damping)
    return np.linalg.solve(scaled, gradient / diagonal) / diagonal


def _scaled(normal: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Roots of a normal matrix's diagonal, and the matrix over them with damping on its diagonal."""
    diagonal = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    scaled = normal / np.outer(diagonal, diagonal)
    scaled[np.diag_indices_from(scaled)] += damping + 1e-9
    return diagonal, scaled


def step_within(
    normal: np.ndarray, gradient: np.ndarray, damping: float, reach: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """`damped_step` within each number's reach: where one cannot go on, the others do what is best without it.

    By the bounded-variable least squares of Stark and Parker (1995).

    Parameters
    ----------
    reach : (array, array)
        How far down and up each number may move, as `reach_of` gives it.
    """
    step = damped_step(normal, gradient, damping)
    if np.all((reach[0] <= step) & (step <= reach[1])):
        return step
    shows = np.diag(normal) > 0
    diagonal, scaled = _scaled(normal[np.ix_(shows, shows)], damping)
    squares, directions = np.linalg.eigh(scaled)
    roots = np.sqrt(np.maximum(squares, ROUNDING * squares.max(initial=0)))
    along = directions.T @ (gradient[shows] / diagonal) / roots
    within = tuple(end[shows] * diagonal for end in reach)
    step[shows] = lsq_linear(roots[:, None] * directions.T, along, within, method="bvls").x / diagonal
    return step


def reach_of(model: Model, keys: Sequence[Key], channels: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """How far down and up `moved` may take each number within its physical range, and each gain's logarithm."""
    values = np.array([model.instance(n).values[p].reshape(-1)[k] for n, p, k in keys])
    parameters = [model.instance(n).effect.parameter(p) for n, p, _ in keys]
    gains = np.full(len(channels), GAIN_REACH)
    low, high = (np.array([getattr(p, end) for p in parameters]) - values for end in ("low", "high"))
    return np.concatenate((np.minimum(low, 0), -gains)), np.concatenate((np.maximum(high, 0), gains))
