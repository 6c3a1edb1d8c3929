"""The screen: how much each effect could explain, from its derivative alone.

A score test: how much of the residual lies in the span of the effect's derivative at "absent" (or at the best of its
starting points, where the derivative at absent does not reach), with the gains and the parameters of all present
effects projected out; those of present effects with more than 100 numbers stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from trainer.captures.batches import Batch, load, signal_variance
from trainer.captures.capture_set import chosen, opened
from trainer.effects.definition import Effect
from trainer.effects.evidence import Evidence
from trainer.effects.own_effect import starts_of
from trainer.fitting.jacobian import Key, keys_of, remaining, stacked, weighted_residuals
from trainer.fitting.least_squares_gain import with_gain
from trainer.fitting.many_numbers import ManySlopes, has_many
from trainer.fitting.predictor import Predictor, lights_of
from trainer.fitting.start_points import start_cost, start_points
from trainer.model.colours_apart import come_apart, may_come_apart
from trainer.model.model import EffectInstance, Model, absent, instance_with
from trainer.prediction.predict import Trace

# A candidate starts with values for each colour where these are expected to remove this share of what common ones
# leave, and this share of what is there.
OWN, LEAST_OWN = 0.7, 0.01
MEASURED = 8  # predictions that it takes about as long to measure captures as


@dataclass(frozen=True)
class ScreenResult:
    """What the screen expects of an effect.

    Attributes
    ----------
    effect : str
    start : EffectInstance
        Where a fit should start.
    before, after : float
        Excess on the screened captures, without the effect and as expected with it.
    whole : bool
        Of a capture of each colour and plane; False: of one alone, and `after` is so much of `before` as it is there.
    """

    effect: str
    start: EffectInstance
    before: float
    after: float
    whole: bool = True

    @property
    def removed_excess(self) -> float:
        """Excess that the effect is expected to remove, on the screened captures."""
        return self.before - self.after


def screen(
    folder: Path, ids: tuple[str, ...], model: Model, effects: tuple[Effect, ...]
) -> list[ScreenResult]:
    """Screen effects on some captures.

    Parameters
    ----------
    folder : Path
        Of the capture set.
    ids : tuple of str
        Captures to screen on.
    model : Model
        With fitted gains.
    """
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    with torch.no_grad():
        return screen_batches(batches, model, effects)


def screen_batches(batches: list[Batch], model: Model, effects: tuple[Effect, ...]) -> list[ScreenResult]:
    """Screen effects on batches, for a model with fitted gains."""
    predictors = [Predictor(model, b) for b in batches]
    points = [p.trace(model) for p in predictors]
    few = [p.effect.name for p in model.present if not has_many(p)]
    residual, present = stacked(model, keys_of(model, few), predictors, points)
    noise = sum(float((b.mask * b.noise).sum()) for b in batches)
    scale = signal_variance(batches)
    before = (remaining(residual, present) - noise) / scale
    narrow, wide = (predictors, points), None
    results = []
    for effect in effects:
        predictors, points = narrow
        if effect.touches_iris:
            wide = wide or _with_band_for(model, absent(effect, model.bench), batches)
            predictors, points = wide
        starts = _starts(effect, model, predictors, points)
        # Starts that open the iris farther than there is room looked alike.
        if effect.touches_iris and _band(model, starts[0], batches[0]) > max(predictors[0].scene.grid.band):
            every = [*start_points(effect, model), *starts]
            widest = max(every, key=lambda start: _band(model, start, batches[0]))
            predictors, points = _with_band_for(model, widest, batches)
            starts = _starts(effect, model, predictors, points)
        expected = [
            (start, (_left(model, start, predictors, points, present) - noise) / scale) for start in starts
        ]
        start, after = expected[0]
        if len(expected) > 1 and after - expected[1][1] > max(OWN * after, LEAST_OWN * before):
            start, after = expected[1]
        results.append(ScreenResult(effect.name, start, before, after))
    return results


def _left(
    model: Model, start: EffectInstance, predictors: list[Predictor], points: list[Trace], present: Tensor
) -> float:
    """Squared error that a straight-line step from an effect's start would leave."""
    trial = model.having(start)
    moved = [p.trace(trial, start.effect.stage, t) for p, t in zip(predictors, points, strict=True)]
    trial = with_gain(trial, predictors, lights_of(trial, predictors, moved))
    if has_many(start):
        return _remaining_of_many(trial, start.effect.name, predictors, moved, present)
    residual, slopes = stacked(trial, keys_of(trial, [start.effect.name]), predictors, moved)
    return remaining(residual, torch.cat([slopes, present]))


def _with_band_for(
    model: Model, start: EffectInstance, batches: list[Batch]
) -> tuple[list[Predictor], list[Trace]]:
    """Predictors whose band has room for what an effect opens, and the model's light there."""
    predictors = [Predictor(model.having(start), b) for b in batches]
    return predictors, [p.trace(model) for p in predictors]


def _band(model: Model, start: EffectInstance, batch: Batch) -> int:
    """The highest frequency index that there is room for where an effect starts there."""
    return max(Predictor(model.having(start), batch).scene.grid.band)


def starts_from_one(effect: Effect) -> bool:
    """Whether one colour and plane say where a fit of an effect starts in all of them."""
    alike = effect.colours == "alike" or (effect.colours == "either" and effect.rugged)
    return alike and effect.starts is None


def shares_of_work(effects: Sequence[Effect], model: Model, count: int) -> list[list[Effect]]:
    """Effects in at most so many shares whose screens take about as long.

    The work is counted in predictions: one for each number of an effect and for each of its starting points, and more
    for a start from which captures are measured.
    """
    each = {e.name: MEASURED if e.measure is not None else 1 for e in effects}
    work = {e.name: each[e.name] * len(start_points(e, model)) + len(_numbers(e, model)) for e in effects}
    shares: list[list[Effect]] = [[] for _ in range(min(count, len(effects)))]
    for effect in sorted(effects, key=lambda e: -work[e.name]):
        min(shares, key=lambda share: sum(work[e.name] for e in share)).append(effect)
    return shares


def _numbers(effect: Effect, model: Model) -> tuple[Key, ...]:
    return keys_of(model.having(absent(effect, model.bench)), [effect.name])


def _starts(
    effect: Effect, model: Model, predictors: list[Predictor], points: list[Trace]
) -> list[EffectInstance]:
    """Where a fit of an effect may start: with values in common, and with each colour's own where it may have these."""
    colours = list(dict.fromkeys(p.scene.channel for p in predictors))
    fewest = {"alike": math.inf, "either": math.inf if effect.rugged else 2, "apart": 1}[effect.colours]
    if len(model.bench.channels) < 2 or len(colours) < fewest:
        return [_start(effect, model, predictors, points)]
    own = absent(effect, model.bench)
    own = come_apart(own, model.bench) if may_come_apart(own, model.bench) else own
    values = {name: rows.copy() for name, rows in own.values.items()}
    for colour in colours:
        pairs = [(p, t) for p, t in zip(predictors, points, strict=True) if p.scene.channel == colour]
        found = _start(effect, model, [p for p, _ in pairs], [t for _, t in pairs])
        rows = found if found.effect.in_common else come_apart(found, model.bench)
        row = pairs[0][0].scene.channel_row()
        for name, of_colours in values.items():
            of_colours[row] = rows.values[name][row]
    own = own.with_values(values)
    if effect.colours == "apart":
        return [own]
    common = _start(effect, model, predictors, points)
    return [common] if has_many(own) else [common, own]


def _start(effect: Effect, model: Model, predictors: list[Predictor], points: list[Trace]) -> EffectInstance:
    starts = start_points(effect, model)
    if effect.starts is not None:
        evidence = []
        for predictor, point in zip(predictors, points, strict=True):
            prediction = predictor.counts(model, predictor.light(model, point))
            evidence.append(Evidence(predictor.scene, predictor.batch, prediction))
        starts += [instance_with(effect, model.bench, values) for values in starts_of(effect, evidence)]
    if len(starts) == 1:
        return starts[0]
    # A start need only be near: one colour and plane are enough.
    few, there = predictors[:1], points[:1]
    at_pupil = effect.stage == "pupil"
    if at_pupil:
        # What the panel sends to other wavelengths is the same for all starts, and nearly so is light from aside.
        there = [p.trace(model.having(starts[0]), "pupil", t) for p, t in zip(few, there, strict=True)]

    def cost(start: EffectInstance) -> float:
        return start_cost(model, few, there, start, nearby=at_pupil)

    # Of a grid of starting values, three that have few in common show whether these change anything.
    last = len(starts) - 1
    tried = range(len(starts)) if effect.starts is not None else sorted({0, last // 2, last})
    known = {k: cost(starts[k]) for k in tried}
    most, least = max(known.values()), min(known.values())
    if most - least < 1e-9 * most and not any(has_many(start) for start in starts):
        # A period or a place changes nothing while the amplitude is zero: compare one step ahead.
        held = _unlike(starts)
        costs = [_one_step_ahead(model, few, there, start, held) for start in starts]
    else:
        costs = [known[k] if k in known else cost(start) for k, start in enumerate(starts)]
    return starts[costs.index(min(costs))]


def _unlike(starts: Sequence[EffectInstance]) -> set[str]:
    """The parameters in which starting points differ."""
    first = starts[0].values
    return {name for name in first if any((s.values[name] != first[name]).any() for s in starts)}


def _one_step_ahead(
    model: Model, predictors: list[Predictor], points: list[Trace], start: EffectInstance, held: set[str]
) -> float:
    """Squared error that a straight-line step from a start would leave, of all parameters but those held."""
    trial = model.having(start)
    keys = tuple(key for key in keys_of(trial, [start.effect.name]) if key[1] not in held)
    return remaining(*stacked(trial, keys, predictors, points))


def _remaining_of_many(
    trial: Model, name: str, predictors: list[Predictor], points: list[Trace], present: Tensor
) -> float:
    """Squared error that a straight-line step of an effect with many numbers would leave."""
    residuals, _ = weighted_residuals(trial, predictors, points)
    others = list(present.split([r.numel() for r in residuals], dim=1))
    slopes = ManySlopes(trial, [name], predictors, points, others)
    there = slopes.along_with_others(slopes.step(residuals))
    left = slopes.alone([r - t for r, t in zip(residuals, there, strict=True)])
    return sum(float((one.double() ** 2).sum()) for one in left)
