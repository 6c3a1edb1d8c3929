"""What a network is trained on: irradiance as the model predicts it, and as the camera saw it, on the panel's pixels.

What the model tells to the camera (blur, offset, response) is taken out of the measurement, not put into the
prediction: the network must not learn faults that the eye never sees. To first order that is

    measured irradiance = predicted irradiance + (counts - predicted counts) / sensitivity

with the difference carried from the camera's pixels to the panel's where the two are not the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import irradiance, panel_phase, pixel_irradiance
from trainer.captures.batches import Batch, load_batch
from trainer.captures.capture_set import Capture, CaptureSet
from trainer.fitting.predictor import Predictor
from trainer.model.export import acting_on_display
from trainer.model.model import Model
from trainer.model.model_stages import scene_for, stages_of
from trainer.prediction.predict import counts, light_path
from trainer.prediction.scene import Scene, Stages

MOST_COLOURS = 3
WHITE = 0.999  # quantile of measured irradiance that is called white
DULL = 0.02  # of the greatest sensitivity: below it the camera says too little

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Pairs:
    """Irradiance predicted and measured, and where the measurement counts, each [N, C, H, W].

    noise : variance of the camera's noise in `measured`. white : irradiance of white in pictures.
    captures : of each picture, by plane; None where a colour is missing
    """

    predicted: Tensor
    measured: Tensor
    weight: Tensor
    noise: Tensor
    white: float
    captures: tuple[tuple[Capture | None, ...], ...]

    def __len__(self) -> int:
        return self.predicted.shape[0]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the panel."""
        return self.predicted.shape[2], self.predicted.shape[3]

    @property
    def colours(self) -> int:
        """Planes of a picture."""
        return self.predicted.shape[1]


@dataclass(frozen=True)
class Measured:
    """One capture on the panel's pixels, each [H, W]: predicted and measured irradiance, weight, noise variance."""

    predicted: Tensor
    measured: Tensor
    weight: Tensor
    noise: Tensor


def pairs_of(
    captures: CaptureSet, rows: Sequence[Capture], model: Model, progress: Progress | None = None
) -> Pairs:
    """The pairs of some captures, under a model whose gains are fitted.

    Colours of one plane are stacked in the order of their patterns. Raises InputError where there is no capture, or
    the bench has more than three colours.
    """
    stacks = stacked(captures, rows)
    if not stacks:
        raise InputError(f"{captures.folder} has no captures to train on: capture some first")
    height, width = captures.bench.panel.shape
    shape = (len(stacks), len(captures.bench.channels), height, width)
    predicted, measured, weight, noise = (torch.zeros(shape) for _ in range(4))
    for k, stack in enumerate(stacks):
        for plane, capture in enumerate(stack):
            if capture is not None:
                one = measured_on_panel(model, load_batch(captures, [capture]))
                predicted[k, plane], measured[k, plane] = one.predicted, one.measured
                weight[k, plane], noise[k, plane] = one.weight, one.noise
        if progress:
            progress((k + 1) / len(stacks))
    seen = measured[weight > 0]
    if not len(seen):
        raise InputError(
            f"every picture of {captures.folder} is saturated: lower the exposure and capture again"
        )
    white = float(np.quantile(seen.numpy(), WHITE))
    return Pairs(predicted, measured, weight, noise, max(white, 1e-6), tuple(stacks))


def stacked(captures: CaptureSet, rows: Sequence[Capture]) -> list[tuple[Capture | None, ...]]:
    """Captures as pictures of all colours: the k-th of each colour and plane together; None where one is missing."""
    names = [c.name for c in captures.bench.channels]
    if len(names) > MOST_COLOURS:
        raise InputError(
            f"the bench has {len(names)} colours, and networks take {MOST_COLOURS}: capture fewer"
        )
    stacks: list[tuple[Capture | None, ...]] = []
    for plane in dict.fromkeys(c.plane_mm for c in rows):
        columns = [[c for c in rows if (c.plane_mm, c.channel) == (plane, name)] for name in names]
        for k in range(max(map(len, columns))):
            stacks.append(tuple(column[k] if k < len(column) else None for column in columns))
    return stacks


def measured_on_panel(model: Model, batch: Batch) -> Measured:
    """Prediction and measurement of one capture (a batch of one) as irradiance on the panel's pixels."""
    scene, stages, expected, sensitivity = expected_counts(model, batch)
    sharp = sensitivity > DULL * sensitivity.max()
    safe = torch.where(sharp, sensitivity, 1.0)
    change = torch.where(sharp, (batch.signal - expected) / safe, 0.0)
    weight = batch.mask * sharp
    noise = batch.noise / safe**2
    shown = display_irradiance(model, batch)
    change, weight, noise = (onto_panel(scene, stages, one[0]) for one in (change, weight, noise))
    weight = (weight > 0.999).to(change.dtype)
    return Measured(shown, shown + change, weight, noise)


def expected_counts(model: Model, batch: Batch) -> tuple[Scene, Stages, Tensor, Tensor]:
    """Counts that a model expects of a batch of one, and counts a unit of light more, each [1, h, w]; where and how."""
    predictor = Predictor(model, batch)
    scene, stages = predictor.scene, predictor.stages(model)
    with torch.no_grad():
        light = predictor.light(model, predictor.trace(model))
        own = _own_gain(scene, stages, light, model, batch)
        gain = model.gain[batch.channel] * batch.exposure[:, None, None] * own
    with torch.enable_grad():
        light.requires_grad_(True)
        expected = counts(scene, stages, light, gain, None)
        (sensitivity,) = torch.autograd.grad(expected.sum(), light)
    return scene, stages, expected.detach(), sensitivity.expand_as(expected)


def _own_gain(scene: Scene, stages: Stages, light: Tensor, model: Model, batch: Batch) -> Tensor:
    """A capture's own gain where laser power drifts, else 1."""
    sensor = stages.sensor
    if not sensor.free_capture_gain:
        return torch.ones(1, 1, 1)
    linear = replace(stages, sensor=replace(sensor, offset=None, response=None, free_capture_gain=False))
    one = counts(scene, linear, light, model.gain[batch.channel] * batch.exposure[:, None, None], None)
    seen = batch.signal if sensor.offset is None else batch.signal - sensor.offset
    total = (seen * one * batch.mask).sum((-2, -1)) / (one**2 * batch.mask).sum((-2, -1))
    return total[:, None, None]


def display_irradiance(model: Model, batch: Batch) -> Tensor:
    """What the display shows of the first pattern of a batch, as its model says, on the panel's pixels [H, W]."""
    shown = acting_on_display(model)
    scene = scene_for(shown, batch.channel, batch.plane_mm)
    with torch.no_grad():
        path = light_path(scene, stages_of(scene, shown))
        return pixel_irradiance(path, irradiance(path, panel_phase(path, batch.gray[:1])))[0]


def onto_panel(scene: Scene, stages: Stages, picture: Tensor) -> Tensor:
    """A picture on the camera's pixels [h, w], seen at the panel's pixels [H, W]; zero where no pixel looks."""
    if same_pixels(scene, stages):
        return picture
    y, x = first_y, first_x = panel_on_camera(scene)
    if stages.sensor.displacement is not None:
        moves = [d.to(picture.dtype).expand(picture.shape) for d in stages.sensor.displacement]
        for _ in range(
            2
        ):  # a camera pixel looks where the one a displacement further on should; they vary slowly
            dy, dx = (sampled(d, y, x) for d in moves)
            y, x = first_y - dy, first_x - dx
    return sampled(picture, y, x)


def onto_camera(scene: Scene, stages: Stages, picture: Tensor) -> Tensor:
    """A picture on the panel's pixels [H, W], seen by the camera's pixels [h, w]; zero outside the panel."""
    if same_pixels(scene, stages):
        return picture
    camera = scene.bench.camera
    y, x = (torch.as_tensor(a, dtype=picture.dtype) for a in np.indices(camera.shape, dtype=float))
    if stages.sensor.displacement is not None:
        y, x = y + stages.sensor.displacement[0], x + stages.sensor.displacement[1]
    return sampled(picture, *camera.on_panel(y, x))


def same_pixels(scene: Scene, stages: Stages) -> bool:
    """Whether camera pixel (i, j) is panel pixel (i, j)."""
    bench = scene.bench
    aligned = bench.camera.registered and bench.camera.shape == bench.panel.shape
    return aligned and stages.sensor.displacement is None


@lru_cache(maxsize=8)
def panel_on_camera(scene: Scene) -> tuple[Tensor, Tensor]:
    """Where on the camera each panel pixel's centre falls, camera pixels (y, x), each [H, W]."""
    y, x = np.indices(scene.bench.panel.shape, dtype=float)
    given = scene.bench.camera.homography
    if given is not None:
        m = np.linalg.inv(np.asarray(given, dtype=float).reshape(3, 3))
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2]
        y, x = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / w, (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / w
    return torch.as_tensor(y, dtype=scene.dtype), torch.as_tensor(x, dtype=scene.dtype)


def sampled(picture: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Cubic interpolation of a picture [h, w] at places in its pixels; zero outside."""
    height, width = picture.shape
    places = torch.stack((2 * x / max(width - 1, 1) - 1, 2 * y / max(height - 1, 1) - 1), -1).to(
        picture.dtype
    )
    return torch.nn.functional.grid_sample(
        picture[None, None], places[None], mode="bicubic", padding_mode="zeros", align_corners=True
    )[0, 0]
