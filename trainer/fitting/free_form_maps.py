"""Free-form maps fitted to captures through a model's light path: what probes and the panel's learned field share.

By L-BFGS with the light path's own gradient, from "absent", and stopped early by captures that the gradient does not
see: what one capture's noise asks of a map is not what the others ask, so the first iterations find what all captures
share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trainer.captures.batches import Batch
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model
from trainer.prediction.predict import Trace, counts, light_on_camera, trace
from trainer.prediction.scene import Scene, Stages

Picture = tuple[str, np.ndarray, str]
Tensors = dict[str, Tensor]

HISTORY = 10  # steps that L-BFGS remembers
PATIENCE = 3  # rounds without progress on the captures that say when to stop


@dataclass(frozen=True)
class FreeFormStage:
    """What is free at a stage. shapes: {name: (shape, physical units a unit of the optimiser's variable)}.

    prior : {name: standard deviation expected, physical units}, where squared errors are in units of their variance
    irradiance : optional `(scene, stages, gray [1, H, W], tensors) -> irradiance`, where the stages alone do not say
        what light there is; None for the light path's own
    """

    stage: str
    shapes: dict[str, tuple[tuple[int, ...], float]]
    apply: Callable[[Stages, Tensors], Stages]
    pictures: Callable[[Tensors], list[Picture]]
    prior: Mapping[str, float] = field(default_factory=dict)
    irradiance: Callable[[Scene, Stages, Tensor, Tensors], Tensor] | None = None


class FreeFormBatch:
    """One batch under a model, ready to be predicted with free maps on top.

    Parameters
    ----------
    inverse_variance : tensor [B, h, w], optional
        What squared errors are multiplied by; without it, they count alike wherever the batch's mask is 1.
    """

    def __init__(self, model: Model, batch: Batch, inverse_variance: Tensor | None = None) -> None:
        self.predictor = Predictor(model, batch)
        self.batch = batch
        self.weight = batch.mask if inverse_variance is None else batch.mask * inverse_variance
        self.stages = self.predictor.stages(model)
        self.gain = model.gain[batch.channel] * batch.exposure[:, None, None]
        with torch.no_grad():
            self.base = self.predictor.trace(model)

    def predict(self, kind: FreeFormStage, tensors: Tensors, k: int) -> Tensor:
        """Counts [1, h, w] of capture k."""
        scene, gray = self.predictor.scene, self.batch.gray[k : k + 1]
        stages = kind.apply(self.stages, tensors)
        before = Trace(self.base.spectrum[k : k + 1], self.base.image[k : k + 1])
        if kind.irradiance is None:
            image = trace(scene, stages, gray, kind.stage, before).image
        else:
            image = kind.irradiance(scene, stages, gray, tensors)
        light = light_on_camera(scene, stages, image)
        measured = (self.batch.signal[k : k + 1], self.batch.mask[k : k + 1])
        return counts(scene, stages, light, self.gain[k : k + 1], measured)

    def squared_error(self, kind: FreeFormStage, tensors: Tensors, k: int) -> Tensor:
        """Weighted squared error of capture k."""
        error = self.batch.signal[k : k + 1] - self.predict(kind, tensors, k)
        return (self.weight[k : k + 1] * error**2).sum()


def descend(
    kind: FreeFormStage,
    seen: Sequence[FreeFormBatch],
    unseen: Sequence[FreeFormBatch],
    scale: float,
    iterations: int,
    rounds: int,
    progress: Callable[[float], None] | None = None,
) -> Tensors:
    """The maps, in physical units, that serve the unseen captures best of those met on the way down.

    scale : that squared errors are divided by, which sets the length of the first step. iterations : between two looks
    at the unseen captures. The way begins at "absent", so what is found is never worse there.
    """
    raw = {n: torch.zeros(shape, requires_grad=True) for n, (shape, _) in kind.shapes.items()}
    optimiser = torch.optim.LBFGS(
        list(raw.values()),
        max_iter=iterations,
        max_eval=2 * iterations,
        history_size=HISTORY,
        tolerance_change=0,
        line_search_fn="strong_wolfe",
    )

    def physical(of: Mapping[str, Tensor]) -> Tensors:
        return {n: t * kind.shapes[n][1] for n, t in of.items()}

    def loss_and_gradient() -> float:
        optimiser.zero_grad()
        maps = physical(raw)
        losses: list[Any] = [((maps[n] / spread) ** 2).sum() / scale for n, spread in kind.prior.items()]
        total = sum(_backward(loss) for loss in losses)
        for working in seen:
            for k in range(len(working.batch.ids)):
                total += _backward(working.squared_error(kind, physical(raw), k) / scale)
        return total

    @torch.no_grad()
    def unseen_error() -> float:
        found = physical(raw)
        return sum(float(w.squared_error(kind, found, k)) for w in unseen for k in range(len(w.batch.ids)))

    best, least = {n: t.detach().clone() for n, t in raw.items()}, unseen_error()
    waited = 0
    for number in range(rounds):
        optimiser.step(loss_and_gradient)
        error = unseen_error()
        if error < least:
            best, least, waited = {n: t.detach().clone() for n, t in raw.items()}, error, 0
        elif (waited := waited + 1) == PATIENCE:
            break
        if progress:
            progress((number + 1) / rounds)
    with torch.no_grad():
        return physical(best)


def _backward(loss: Tensor) -> float:
    loss.backward()
    return float(loss.detach())
