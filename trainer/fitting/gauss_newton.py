"""Fits of effects to captures: damped Gauss-Newton on the same error that is reported.

Columns of the Jacobian are secants one small physical step wide. Each costs one prediction from the effect's own
stage on. A secant is also good for an iris edge or a laser line, whose derivative is zero or jumps where the effect
is absent. The fit minimises the squared error in counts, unweighted: the reported excess. The gain of each colour is
always fitted too.

An effect of more than 100 numbers has no such table: its part of each step comes from `many_numbers`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from runtime.excess import PredictionErrors
from runtime.program.progress import Progress
from trainer.captures.batches import Batch, signal_variance
from trainer.device import array_of
from trainer.effects.definition import STAGES
from trainer.effects.own_effect import measured_by
from trainer.fitting.jacobian import (
    Key,
    away_from_absent,
    follow,
    keys_of,
    moved,
    reach_of,
    slopes_of,
    step_within,
    weighted_residuals,
)
from trainer.fitting.least_squares_gain import with_gain
from trainer.fitting.many_numbers import ManySlopes, has_many
from trainer.fitting.predictor import Predictor, lights_of
from trainer.model.model import Model, Values
from trainer.prediction.predict import Trace

HOLD = 0.01  # `hold` of fits far from the truth
ROUGH = 5e-3  # `tolerance` of fits that only compare, or that others follow
# A fit is given up where a step is expected to leave more than so many times enough, and this share of what there is;
# and where it would not come there if each step that it still has removed so many times what the last one did.
FAR, SLOW, FASTER = 10.0, 0.5, 2.0
# A step that lowers the excess by less than LITTLE is the last one. It is expected to do much where it may leave
# PROMISING of the excess at most, and lower it by MUCH.
LITTLE, PROMISING, MUCH = 2e-6, 0.8, 2e-5
# Share of the squared change that a step was not expected to make, up to which derivatives are taken for constant.
STRAIGHT = 0.1
BLOCK = 1 << 18  # pixels


@dataclass(frozen=True)
class FitResult:
    """A fitted model.

    Attributes
    ----------
    model : Model
        With fitted values and their standard errors.
    errors : PredictionErrors
        On the captures that it was fitted to.
    covariance : array [keys + colours, keys + colours]
        Of the fitted numbers, then of the logarithms of the gains.
    keys : tuple
        (effect, parameter, index into its values) of each fitted number.
    settled : bool
        Whether further steps would have changed little; False where their number was at its end.
    """

    model: Model
    errors: PredictionErrors
    covariance: np.ndarray
    keys: tuple[Key, ...]
    settled: bool


def fit(
    model: Model,
    free: Sequence[str],
    batches: Sequence[Batch],
    iterations: int = 12,
    tolerance: float = 1e-3,
    progress: Progress | None = None,
    hold: float = 0.0,
    fixed: Collection[tuple[str, str]] = (),
    enough: float = math.inf,
    slopes: list[Tensor] | None = None,
) -> FitResult:
    """Fit the named effects of a model, and the gains, to batches.

    Stops after `iterations`, or when a step lowers the excess by less than `tolerance` of it or less than LITTLE,
    unless that step had to be shortened where a whole one was expected to do much, or far from the truth (`hold`).
    No step leaves the numbers' physical ranges.
    Errors of values are standard errors from the residuals themselves (a sandwich estimate), so misfit widens them; NaN
    where the captures do not determine a value: such a value stays as it is.

    Parameters
    ----------
    free : sequence of str
        Names of the effects to fit; the others keep their values.
    progress : callable, optional
        Called with the share of the iterations that is done.
    hold : float
        Each number at the end of its typical range adds this share of the excess to what a step minimises. Far from the
        truth, shift and tilt, or distance, curvature and magnification, change pictures alike: of numbers that do as
        well, those nearest to "absent" are found. For tables of derivatives only, as `fixed` is.
    fixed : collection of (str, str)
        Effects and those of their parameters that keep their values.
    enough : float
        Excess at which the fit is of use: it is given up where it will hardly come there.
    slopes : list of Tensor, optional
        Derivatives of each batch's prediction by the model, as from `slopes_of`, where they are known. Overwritten.
    """
    with torch.no_grad():
        if _fits_response(model, free):
            model = replace(model, response_known_to=None)
        many = tuple(n for n in free if has_many(model.instance(n)))
        if many:
            return _fit_many(model, tuple(free), many, batches, iterations, tolerance, progress, enough)
        return _fit(model, tuple(free), batches, iterations, tolerance, progress, hold, fixed, enough, slopes)


def _fit(
    model: Model,
    free: tuple[str, ...],
    batches: Sequence[Batch],
    iterations: int,
    tolerance: float,
    progress: Progress | None,
    hold: float,
    fixed: Collection[tuple[str, str]],
    enough: float,
    slopes: list[Tensor] | None,
) -> FitResult:
    predictors = [Predictor(model, b) for b in batches]
    keys = tuple(key for key in keys_of(model, free) if key[:2] not in fixed)
    ranges = _typical_ranges(model, keys)
    scale = signal_variance(batches)
    first = min((model.instance(n).effect.stage for n in free), key=STAGES.index, default="sensor")
    points = [p.trace(model) for p in predictors]
    model = _having_gains(model, predictors, points)
    channels = list(dict.fromkeys(b.channel for b in batches))
    if slopes is None:
        slopes = slopes_of(model, keys, channels, predictors, points)
    residuals, errors = weighted_residuals(model, predictors, points)
    damping, fresh, settled = 1e-3, True, True
    for iteration in range(iterations):
        if progress:
            progress(iteration / iterations)
        before = errors.excess
        normal, gradient = _normal(slopes), _gradient(slopes, residuals)
        reach = reach_of(model, keys, channels)
        whole = step_within(normal, gradient, 0.0, reach)
        left = before - float(2 * gradient @ whole - whole @ normal @ whole) / scale
        if fresh and before > FAR * enough and left > max(FAR * enough, SLOW * before):
            settled = False
            break
        pull = hold * max(before, 0.0)
        away = _away(model, keys, ranges)
        if pull:
            normal[range(len(keys)), range(len(keys))] += pull * scale / ranges**2
            gradient[: len(keys)] -= pull * scale * away / ranges
        accepted, raised = False, False
        for _ in range(6 if fresh else 1):
            step = step_within(normal, gradient, damping, reach)
            trial = moved(model, keys, channels, step)
            trial_points = [p.trace(trial, first, t) for p, t in zip(predictors, points, strict=True)]
            trial_residuals, trial_errors = weighted_residuals(trial, predictors, trial_points)
            paid = pull * float((_away(trial, keys, ranges) ** 2 - away**2).sum()) if pull else 0.0
            if trial_errors.excess + paid < before:
                accepted = True
                break
            damping, raised = max(damping, 1e-4) * 8, True
        straight = False
        if accepted:
            if hold > 0 and tolerance >= ROUGH:
                changes = [old - new for old, new in zip(residuals, trial_residuals, strict=True)]
                straight = follow(slopes, changes, step) < STRAIGHT
            model, points = trial, trial_points
            residuals, errors = trial_residuals, trial_errors
            damping = max(damping / 10, 1e-7)
        elif fresh:
            break
        removed_excess = before - errors.excess
        promising = hold > 0 or before - left > max((1 - PROMISING) * before, MUCH)
        if (
            fresh
            and not (raised and promising)
            and removed_excess < max(tolerance * abs(errors.excess), LITTLE)
        ):
            break
        if fresh and is_too_slow(removed_excess, iterations - iteration - 1, errors.excess, enough):
            settled = False
            break
        # Secants are costly: they are used again while a step still removes more than half of what is left. Where a
        # step did what they had expected, those of a rough fit far from the truth are as good as new. (Where candidates
        # are compared, what such a fit leaves over decides which is first.)
        fresh = straight or not removed_excess > 0.5 * before
        if fresh and not straight and iteration + 1 < iterations:
            slopes = slopes_of(model, keys, channels, predictors, points)
    else:
        settled = False
    normal, scatter = _normal(slopes), _scatter(slopes, residuals)
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    covariance = inverse @ scatter @ inverse
    spread = _spread(keys, covariance, normal)
    model = _known_as_far_as_seen(model, free, predictors, points)
    model = with_measured_values(_with_errors(model, keys, spread), free, batches)
    return FitResult(model, errors, covariance, keys, settled)


def _fit_many(
    model: Model,
    free: tuple[str, ...],
    many: tuple[str, ...],
    batches: Sequence[Batch],
    iterations: int,
    tolerance: float,
    progress: Progress | None,
    enough: float,
) -> FitResult:
    """The same fit where the effects `many` have too many numbers for a table of derivatives."""
    predictors = [Predictor(model, b) for b in batches]
    few = tuple(n for n in free if n not in many)
    first = min((model.instance(n).effect.stage for n in free), key=STAGES.index)
    keys = keys_of(model, few)
    points = [p.trace(model) for p in predictors]
    model = _having_gains(model, predictors, points)
    channels = list(dict.fromkeys(b.channel for b in batches))
    residuals, errors = weighted_residuals(model, predictors, points)
    settled = True
    for iteration in range(iterations):
        if progress:
            progress(iteration / iterations)
        before = errors.excess
        table = slopes_of(model, keys, channels, predictors, points)
        slopes = ManySlopes(model, many, predictors, points, table)
        change = slopes.step(residuals)
        # What the few numbers do best when the many have moved.
        along = slopes.along_with_others(change)
        rest = array_of(slopes.explained([r - s for r, s in zip(residuals, along, strict=True)]))
        accepted = False
        for share in (1.0, 0.5, 0.2, 0.05):
            trial = moved(slopes.moved(share * change), keys, channels, share * rest)
            trial_points = [p.trace(trial, first, t) for p, t in zip(predictors, points, strict=True)]
            trial_residuals, trial_errors = weighted_residuals(trial, predictors, trial_points)
            if trial_errors.excess < before:
                accepted = True
                break
        if not accepted:
            break
        model, points, residuals, errors = trial, trial_points, trial_residuals, trial_errors
        removed_excess = before - errors.excess
        if removed_excess < max(tolerance * abs(errors.excess), LITTLE):
            break
        if is_too_slow(removed_excess, iterations - iteration - 1, errors.excess, enough):
            settled = False
            break
    else:
        settled = False
    table = slopes_of(model, keys, channels, predictors, points)
    slopes = ManySlopes(model, many, predictors, points, table)
    spread_of_many = slopes.errors(residuals)
    normal = _normal(table)
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    covariance = inverse @ _scatter(table, residuals) @ inverse
    every = (*keys, *keys_of(model, many))
    whole = np.zeros((len(every) + len(channels),) * 2)
    places = [*range(len(keys)), *range(len(every), len(whole))]
    whole[np.ix_(places, places)] = covariance
    inner = np.arange(len(keys), len(every))
    whole[inner, inner] = spread_of_many**2
    spread = np.concatenate([_spread(keys, covariance, normal), spread_of_many])
    model = _known_as_far_as_seen(model, free, predictors, points)
    model = with_measured_values(_with_errors(model, every, spread), free, batches)
    return FitResult(model, errors, whole, every, settled)


def _fits_response(model: Model, free: Sequence[str]) -> bool:
    """Whether a fit may bend the camera's response."""
    return any(model.instance(n).effect.stage == "sensor" for n in free)


def _known_as_far_as_seen(
    model: Model, free: Sequence[str], predictors: Sequence[Predictor], points: Sequence[Trace]
) -> Model:
    """The model whose camera's response is known up to the brightest light in the pictures that it was fitted to."""
    if not _fits_response(model, free):
        return model
    found = [p.brightest(model, t) for p, t in zip(predictors, points, strict=True)]
    return replace(model, response_known_to=max((share for share in found if share), default=None))


def _having_gains(model: Model, predictors: Sequence[Predictor], points: Sequence[Trace]) -> Model:
    """The model with gains, where it lacks them, and where captures have their own, of which these are the mean.

    What light the laser adds is counted in them, and steps leave them as they are.
    """
    known = all(p.batch.channel in model.gain for p in predictors)
    if known and not any(p.has_own_gains(model) for p in predictors):
        return model
    return with_gain(model, predictors, lights_of(model, predictors, points))


def is_too_slow(removed: float, steps: int, error: float, enough: float) -> bool:
    """Whether a fit whose last step removed so much will hardly bring the error to `enough` in so many more."""
    return error - FASTER * steps * max(removed, 0.0) > enough


@torch.no_grad()
def with_measured_values(model: Model, free: Sequence[str], batches: Sequence[Batch]) -> Model:
    """The model with the values that its named effects read off the captures instead of fitting them.

    These have no errors: they say how far captures differ.
    """
    for name in free:
        present = model.instance(name)
        if present.effect.measure is None:
            continue
        without = model.without(name)
        evidence = [Predictor(without, b).evidence(without) for b in batches]
        read = measured_by(present.effect, evidence, present.order)
        values = {n: np.full_like(v, read[n]) if n in read else v for n, v in present.values.items()}
        errors = {n: np.full_like(v, np.nan) if n in read else v for n, v in (present.errors or {}).items()}
        model = model.having(replace(present, values=values, errors=errors or None))
    return model


def _typical_ranges(model: Model, keys: tuple[Key, ...]) -> np.ndarray:
    """How far from "absent" each number's typical range reaches."""
    found = []
    for name, parameter, _ in keys:
        p = model.instance(name).effect.parameter(parameter)
        absent = p.absent_value(model.bench)
        found.append(20 * p.scale if p.typical is None else max(abs(end - absent) for end in p.typical))
    return np.array(found)


def _away(model: Model, keys: tuple[Key, ...], ranges: np.ndarray) -> np.ndarray:
    """How far from "absent" each number is, in units of its typical range."""
    return np.array([away_from_absent(model, key) for key in keys]) / ranges


def _normal(slopes: list[Tensor]) -> np.ndarray:
    return sum(array_of((s @ s.T).double()) for s in slopes)  # type: ignore[return-value]


def _gradient(slopes: list[Tensor], residuals: list[Tensor]) -> np.ndarray:
    return sum(array_of((s @ r).double()) for s, r in zip(slopes, residuals, strict=True))  # type: ignore[return-value]


def _scatter(slopes: list[Tensor], residuals: list[Tensor]) -> np.ndarray:
    """Sum over pixels of the outer product of their terms of the gradient; without a second table in memory."""
    blocks = (
        s * r
        for table, own in zip(slopes, residuals, strict=True)
        for s, r in zip(table.split(BLOCK, dim=1), own.split(BLOCK), strict=True)
    )
    return sum(array_of((b @ b.T).double()) for b in blocks)  # type: ignore[return-value]


def _spread(keys: tuple[Key, ...], covariance: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Standard errors of the numbers; NaN for one that the captures do not determine, as it changes nothing in them."""
    count = len(keys)
    spread = np.sqrt(np.maximum(np.diag(covariance)[:count], 0))
    return np.where(np.diag(normal)[:count] > 0, spread, np.nan)


def _with_errors(model: Model, keys: tuple[Key, ...], spread: np.ndarray) -> Model:
    for name in dict.fromkeys(k[0] for k in keys):
        present = model.instance(name)
        moved = [p.name for p in present.effect.parameters if not p.per_pixel]
        errors: Values = {n: np.zeros_like(present.values[n]) for n in moved}
        for i, (effect_name, parameter, index) in enumerate(keys):
            if effect_name == name:
                errors[parameter].reshape(-1)[index] = spread[i]
        model = model.having(replace(present, errors=errors))
    return model
