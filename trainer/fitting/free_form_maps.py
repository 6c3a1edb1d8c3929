"""Free-form maps fitted to captures through a model's light path, for probes and for the panel's learned field.

By L-BFGS (Liu and Nocedal 1989) with the light path's own gradient, from "absent". The descent stops early, by
captures that the gradient does not use: noise differs from capture to capture, so the first iterations find what all
captures share.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from runtime.program.progress import Progress
from trainer.captures.batches import Batch
from trainer.fitting.gauss_newton import is_too_slow
from trainer.fitting.predictor import Predictor
from trainer.fitting.side_by_side import side_by_side
from trainer.model.model import Model
from trainer.prediction.camera_light import counts, light_on_camera, motion_on_camera
from trainer.prediction.free_stages import FreeFormStage, Tensors
from trainer.prediction.predict import trace

HISTORY = 10  # steps that L-BFGS keeps
PATIENCE = 3  # rounds without progress on the captures that say when to stop


class FreeFormBatch:
    """One batch under a model, prepared for predictions with free maps.

    Parameters
    ----------
    inverse_variance : tensor [B, h, w], optional
        What squared errors are multiplied by; without it, they count alike wherever the batch's mask is 1.
    """

    def __init__(self, model: Model, batch: Batch, inverse_variance: Tensor | None = None) -> None:
        self.predictor = Predictor(model, batch)
        self.batch = batch
        self.weight = batch.mask if inverse_variance is None else batch.mask * inverse_variance
        self.stages = [stages for _, stages in self.predictor.parts(model)]
        if not model.in_time:  # all share what `exposed` then tells apart
            self.stages = [
                self.predictor.exposed(self.stages[0], slice(k, k + 1)) for k in range(len(batch.ids))
            ]
        self.gain = self.predictor.gain(model)
        with torch.no_grad():
            self.base = self.predictor.trace(model)

    def predict(self, free: FreeFormStage, tensors: Tensors, k: int) -> Tensor:
        """Counts [1, h, w] of capture k."""
        scene, gray = self.predictor.scene, self.batch.gray[k : k + 1]
        stages = free.apply(self.stages[k], tensors)
        before = self.base.of(k)
        if free.irradiance is None:
            earlier = self.predictor.earlier(stages, k)
            image = trace(scene, stages, gray, free.stage, before, earlier).image
        else:
            image = free.irradiance(scene, stages, gray, tensors)
        measured = (self.batch.signal[k : k + 1], self.batch.mask[k : k + 1])
        light = light_on_camera(scene, stages, image, motion_on_camera(scene, stages, image, measured))
        return counts(scene, stages, light, self.gain[k : k + 1], measured)

    def squared_error(self, free: FreeFormStage, tensors: Tensors, k: int) -> Tensor:
        """Weighted squared error of capture k."""
        error = self.batch.signal[k : k + 1] - self.predict(free, tensors, k)
        return (self.weight[k : k + 1] * error**2).sum()


def descend(
    free: FreeFormStage,
    fitted: Sequence[FreeFormBatch],
    stopping: Sequence[FreeFormBatch],
    scale: float,
    iterations: int,
    rounds: int,
    progress: Progress | None = None,
    needed: float = -math.inf,
) -> Tensors:
    """The maps of the descent that predict the stopping captures best.

    The descent begins at "absent", so the result is never worse on the stopping captures.

    Parameters
    ----------
    fitted : sequence of FreeFormBatch
        Captures whose squared error is minimised.
    stopping : sequence of FreeFormBatch
        Captures that choose the best maps, and end the descent when they no longer improve.
    scale : float
        What squared errors are divided by, which sets the length of the first step.
    iterations : int
        Between two checks of the stopping captures.
    rounds : int
        Most checks.
    needed : float
        Squared error of the stopping captures that a descent must remove to be of use: it is given up where it will
        hardly do so.

    Returns
    -------
    dict of tensors
        Maps by name, in physical units.

    References
    ----------
    Liu and Nocedal 1989.
    """
    each = [(one, k) for one in fitted for k in range(len(one.batch.ids))]
    pixels = fitted[0].batch.gray[0].numel()
    raw = {n: torch.zeros(shape, requires_grad=True) for n, (shape, _) in free.shapes.items()}
    optimiser = torch.optim.LBFGS(
        list(raw.values()),
        max_iter=iterations,
        max_eval=2 * iterations,
        history_size=HISTORY,
        tolerance_change=0,
        line_search_fn="strong_wolfe",
    )

    def physical(of: Mapping[str, Tensor]) -> Tensors:
        return {n: t * free.shapes[n][1] for n, t in of.items()}

    @torch.enable_grad()
    def of_capture(which: tuple[FreeFormBatch, int]) -> tuple[float, tuple[Tensor | None, ...]]:
        one, k = which
        return _with_gradient(one.squared_error(free, physical(raw), k) / scale, raw)

    def loss_and_gradient() -> float:
        maps = physical(raw)
        priors = [((maps[n] / spread) ** 2).sum() / scale for n, spread in free.prior.items()]
        parts = [_with_gradient(loss, raw) for loss in priors]
        with torch.no_grad():
            parts += side_by_side(of_capture, each, pixels)
            for k, variable in enumerate(raw.values()):
                slopes = [slope for _, part in parts if (slope := part[k]) is not None]
                variable.grad = sum(slopes, torch.zeros_like(variable))
        return sum(loss for loss, _ in parts)

    @torch.no_grad()
    def stopping_error() -> float:
        found = physical(raw)
        return sum(float(b.squared_error(free, found, k)) for b in stopping for k in range(len(b.batch.ids)))

    best, least = {n: t.detach().clone() for n, t in raw.items()}, stopping_error()
    most, waited = least - needed, 0
    for number in range(rounds):
        optimiser.step(loss_and_gradient)
        error = stopping_error()
        removed = least - error
        if error < least:
            best, least, waited = {n: t.detach().clone() for n, t in raw.items()}, error, 0
        elif (waited := waited + 1) == PATIENCE:
            break
        if is_too_slow(removed, rounds - number - 1, error, most):
            break
        if progress:
            progress((number + 1) / rounds)
    with torch.no_grad():
        return physical(best)


def _with_gradient(loss: Tensor, variables: Tensors) -> tuple[float, tuple[Tensor | None, ...]]:
    """A loss and its gradient over each variable, None for one that it does not depend on."""
    return float(loss.detach()), torch.autograd.grad(loss, tuple(variables.values()), allow_unused=True)
