"""Predictions of captures under changing models, each from the first stage that changed."""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from runtime.excess import PredictionErrors, joined
from trainer.captures.batches import Batch, load_batch
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.effects.evidence import Evidence
from trainer.fitting.side_by_side import side_by_side
from trainer.kept_results import kept_for_same
from trainer.model.model import Model
from trainer.model.model_stages import scene_for, stages_of
from trainer.prediction.camera_light import (
    counts,
    laser_counts,
    light_on_camera,
    motion_near,
    motion_on_camera,
)
from trainer.prediction.capture_gain import own_gain
from trainer.prediction.capture_motion import Motion, MotionNearby
from trainer.prediction.predict import Trace, trace
from trainer.prediction.scene import Scene, Stages
from trainer.prediction.stages import Sensor

SMALL = 1e-3  # share of full scale: a step along a bent response for its slope


@kept_for_same(2)  # what is kept for a sensor is found again where all captures share it
def _exposed(sensor: Sensor, exposure: Tensor) -> Sensor:
    return replace(sensor, exposure=exposure)


NearMotions = list[MotionNearby | None]  # of each part of a batch


@dataclass
class _Moving:
    """The captures' motions under a model, of each part of a batch; `near` is made when it is first asked for."""

    present: object
    learned: object
    point: weakref.ref[Trace]
    motions: list[Motion | None]
    near: NearMotions | None = None


class Predictor:
    """Predictions of one batch under changing models, each from the first stage that changed."""

    def __init__(self, model: Model, batch: Batch) -> None:
        self.scene: Scene = scene_for(model, batch.channel, batch.plane_mm, batch.signal.dtype)
        self.batch = batch
        exposure = batch.exposure / batch.usual_exposure
        self._exposure = None if bool((exposure == 1).all()) else exposure[:, None, None]
        self._kept: deque[_Moving] = deque(maxlen=2)

    def stages(self, model: Model, k: int | None = None, tensors: Any = None) -> Stages:
        """The scene's stages under a model for capture k, or for all: at the moment of the first, where that matters.

        Parameters
        ----------
        tensors : mapping, optional
            As in `trainer.model.model_stages.stages_for`.
        """
        moments = self.batch.moments
        stages = stages_of(self.scene, model, tensors, moments[k or 0] if moments else None)
        return self.exposed(stages, slice(None) if k is None else slice(k, k + 1))

    def exposed(self, stages: Stages, part: slice) -> Stages:
        """The stages with a sensor that knows the exposures of some captures, where these change what light it adds."""
        exposure = self._exposure
        if exposure is None or stages.sensor.constant is None:
            return stages
        own = exposure if part == slice(None) else exposure[part]
        return replace(stages, sensor=_exposed(stages.sensor, own))

    def has_own_gains(self, model: Model) -> bool:
        """Whether each capture has its own gain; the colour's then only says what light of the laser is counted in."""
        return self.stages(model).sensor.free_capture_gain

    def parts(self, model: Model) -> list[tuple[slice, Stages]]:
        """Captures of the batch that share their stages, with these: all, or each where the model changes in time."""
        if not model.in_time:
            return [(slice(None), self.stages(model))]
        return [(slice(k, k + 1), self.stages(model, k)) for k in range(len(self.batch.ids))]

    def trace(
        self, model: Model, start: str = "drive", before: Trace | None = None, nearby: bool = False
    ) -> Trace:
        """Spectrum and irradiance of the batch, a capture at a time to stay in the processor's cache.

        Parameters
        ----------
        start : str
            The first stage that `model` changes.
        before : Trace, optional
            Of a model that is equal before that stage; without it everything is computed.
        nearby : bool
            The model is a small step from that of `before`, as in `trainer.prediction.predict.trace`.
        """
        if before is not None and start == "sensor":
            return before
        shared = None if model.in_time else self.stages(model)

        def part(k: int) -> Trace:
            stages = shared or self.stages(model, k)
            one = None if before is None else before.of(k)
            gray, earlier = self.batch.gray[k : k + 1], self.earlier(stages, k)
            return trace(self.scene, stages, gray, start, one, earlier, nearby)

        parts = side_by_side(part, range(self.batch.gray.shape[0]), self.batch.gray[0].numel())
        return Trace.joined(parts)

    def earlier(self, stages: Stages, k: int) -> Tensor | None:
        """Patterns shown before capture k [1, n, H, W], where the panel still shows something of them."""
        return None if stages.drive.persistence is None else self.batch.shown_before()[k : k + 1]

    def motions(self, model: Model, point: Trace) -> NearMotions:
        """What `light` needs of models that are a small step away."""
        moving = self._moving(model, point)
        if moving.near is None:
            moving.near = [
                None
                if motion is None
                else motion_near(self.scene, stages, point.image[part], self._seen(part), motion)
                for (part, stages), motion in zip(self.parts(model), moving.motions, strict=True)
            ]
        return moving.near

    def light(self, model: Model, point: Trace, near: NearMotions | None = None) -> Tensor:
        """Irradiance on the camera [B, h, w].

        Parameters
        ----------
        near : list, optional
            The motions of a model that is a small step away, for derivatives and for a search.
        """
        parts = self.parts(model)
        motions: Sequence[Motion | MotionNearby | None]
        if near is None:
            motions = self._moving(model, point).motions
        else:
            motions = [
                one if one is not None and one.suits(stages.sensor) else self._motion(stages, point, part)
                for (part, stages), one in zip(parts, near, strict=True)
            ]
        found = [
            light_on_camera(self.scene, stages, point.image[part], motion)
            for (part, stages), motion in zip(parts, motions, strict=True)
        ]
        return found[0] if len(found) == 1 else torch.cat(found)

    def _moving(self, model: Model, point: Trace) -> _Moving:
        """The captures' motions: measuring them is most of the work, so those of the last two models are kept."""
        for one in self._kept:
            if one.present is model.present and one.learned is model.learned and one.point() is point:
                return one
        motions = [self._motion(stages, point, part) for part, stages in self.parts(model)]
        one = _Moving(model.present, model.learned, weakref.ref(point), motions)
        self._kept.append(one)
        return one

    def _motion(self, stages: Stages, point: Trace, part: slice) -> Motion | None:
        return motion_on_camera(self.scene, stages, point.image[part], self._seen(part))

    def _seen(self, part: slice) -> tuple[Tensor, Tensor]:
        return self.batch.signal[part], self.batch.mask[part]

    def counts(self, model: Model, light: Tensor, own: Tensor | None = None) -> Tensor:
        """Counts above black [B, h, w], from the irradiance on the camera [B, h, w].

        Parameters
        ----------
        own : Tensor [B, 1, 1], optional
            The captures' own gains, as `own_gains` gives them; without it they are found anew.
        """
        return self.batch.as_compared(self._counts(model, light, own, self.parts(model)))

    def _counts(
        self, model: Model, light: Tensor, own: Tensor | None, parts: Sequence[tuple[slice, Stages]]
    ) -> Tensor:
        """Counts [B, h, w] of the stages of `parts`, as the camera counts them."""
        gain = self.gain(model)
        found = [
            counts(
                self.scene,
                stages,
                light[part],
                gain[part],
                self._seen(part),
                None if own is None else own[part],
            )
            for part, stages in parts
        ]
        return found[0] if len(found) == 1 else torch.cat(found)

    def own_gains(self, model: Model, light: Tensor) -> Tensor | None:
        """Each capture's own gain [B, 1, 1], from the irradiance on the camera [B, h, w]; None where it has none."""
        if not self.has_own_gains(model):
            return None
        gain = self.gain(model)
        found = [
            own_gain(stages.sensor, laser_counts(stages.sensor, light[part], gain[part]), self._seen(part))
            for part, stages in self.parts(model)
        ]
        return found[0] if len(found) == 1 else torch.cat(found)

    def brightest(self, model: Model, point: Trace) -> float | None:
        """Light of the brightest pixel that counts, as a share of full scale; None where the response is straight."""
        sensor = self.stages(model).sensor
        if sensor.response is None:
            return None
        light = self.light(model, point)
        seen = self.batch.mask if self.batch.seen is None else self.batch.seen
        straight = self._straight(model, light, self.own_gains(model, light))
        return float((seen * straight).max()) / sensor.full_scale

    def _straight(self, model: Model, light: Tensor, own: Tensor | None) -> Tensor:
        """Counts [B, h, w] that a straight response would give, with the captures' own gains behind the bent one."""
        parts = [
            (part, replace(stages, sensor=replace(stages.sensor, response=None)))
            for part, stages in self.parts(model)
        ]
        return self._counts(model, light, own, parts)

    def evidence(self, model: Model) -> Evidence:
        """The batch beside its prediction, as effects read values off it."""
        light, sensor = self.light(model, self.trace(model)), self.stages(model).sensor
        own = self.own_gains(model, light)
        predicted = self.counts(model, light, own)
        if sensor.response is None or self.batch.seen is not None:
            return Evidence(self.scene, self.batch, predicted)
        straight = self._straight(model, light, own)
        step = SMALL * sensor.full_scale
        slope = (sensor.responded(straight + step) - sensor.responded(straight - step)) / (2 * step)
        return Evidence(self.scene, self.batch, predicted, straight, slope)

    def gain(self, model: Model) -> Tensor:
        """Counts [B, 1, 1] for one unit of light, before the captures' own gains."""
        return model.gain[self.batch.channel] * self.batch.exposure[:, None, None]

    def predict(self, model: Model) -> Tensor:
        """Counts above black [B, h, w]."""
        return self.counts(model, self.light(model, self.trace(model)))

    def predict_nearby(
        self,
        model: Model,
        start: str,
        before: Trace,
        near: NearMotions | None = None,
        own: Tensor | None = None,
    ) -> Tensor:
        """Counts above black [B, h, w] of a model that is a small step away from stage `start` on."""
        point = self.trace(model, start, before, nearby=True)
        return self.counts(model, self.light(model, point, near), own)


def lights_of(
    model: Model,
    predictors: Sequence[Predictor],
    points: Sequence[Trace],
    near: Sequence[NearMotions | None] | None = None,
) -> list[Tensor]:
    """Irradiance on the camera [B, h, w] of each predictor's batch; `near` as in `Predictor.light`."""
    near = [None] * len(predictors) if near is None else near
    return [p.light(model, t, n) for p, t, n in zip(predictors, points, near, strict=True)]


def evaluate_captures(captures: CaptureSet, rows: Sequence[Capture], model: Model) -> PredictionErrors:
    """Errors of a model on captures: of large ones, one in memory at a time."""

    def errors(row: Capture) -> PredictionErrors:
        batch = load_batch(captures, [row])
        return batch.errors(Predictor(model, batch).predict(model))

    with torch.no_grad():
        return joined(side_by_side(errors, rows, captures.bench.panel.width * captures.bench.panel.height))


@torch.no_grad()
def excess_on(model: Model, batches: Sequence[Batch]) -> float:
    """Excess of a model on batches that are loaded."""
    return joined([b.errors(Predictor(model, b).predict(model)) for b in batches]).excess


def telling(model: Model, batch: Batch, count: int) -> Batch:
    """The captures of a batch of which a model leaves most unexplained, in counts, in their order."""
    left = _unexplained(model, batch)
    return batch.only(sorted(left.argsort(descending=True)[:count].tolist()))


def telling_batches(model: Model, batches: Sequence[Batch], count: int) -> Sequence[Batch]:
    """The batches with the captures of which a model leaves most unexplained, in counts; all if there are no more."""
    if len(batches) <= count:
        return batches
    return sorted(batches, key=lambda b: -float(_unexplained(model, b).max()))[:count]


def _unexplained(model: Model, batch: Batch) -> Tensor:
    """Squared error of each capture [B], in counts."""
    return (batch.mask * (batch.signal - Predictor(model, batch).predict(model)) ** 2).sum((1, 2))
