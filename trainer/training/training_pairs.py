"""What a network is trained on: predicted and measured irradiance, on the panel's pixels.

Effects that act on the camera alone (blur, offset, response) are taken out of the measurement, not put into the
prediction: the network must not learn faults that the eye never sees. To first order that is

    measured irradiance = predicted irradiance + (counts - predicted counts) / sensitivity

with the difference carried from the camera's pixels to the panel's where the two are not the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import irradiance, panel_phase, pixel_irradiance
from runtime.program.progress import Progress
from trainer.captures.batches import Batch, load_batch
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.fitting.predictor import Predictor
from trainer.model.bundle_export import acting_on_display
from trainer.model.model import Model
from trainer.prediction.camera_light import counts
from trainer.prediction.predict import light_path
from trainer.prediction.scene import Scene, Stages
from trainer.training.camera_to_panel import onto_panel

MOST_COLOURS = 3
WHITE = 0.999  # quantile of measured irradiance that is called white
DULL = 0.02  # of the greatest sensitivity: below it the camera measures too little


@dataclass(frozen=True)
class Pairs:
    """Predicted and measured irradiance of N pictures, in the host's memory.

    Attributes
    ----------
    predicted, measured : Tensor [N, C, H, W]
        Irradiance on the panel's pixels.
    weight : Tensor [N, C, H, W]
        1 where the measurement counts, else 0.
    noise : Tensor [N, C, H, W]
        Variance of the camera's noise in `measured`.
    white : float
        Irradiance of white in pictures.
    captures : tuple of tuple of Capture or None
        Of each picture, by colour; None where a colour is missing.
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
        """Colours of a picture."""
        return self.predicted.shape[1]


@dataclass(frozen=True)
class PanelMeasurement:
    """One capture on the panel's pixels.

    Attributes
    ----------
    predicted, measured : Tensor [H, W]
        Irradiance.
    weight : Tensor [H, W]
        1 where the measurement counts, else 0.
    noise : Tensor [H, W]
        Variance of the camera's noise in `measured`.
    """

    predicted: Tensor
    measured: Tensor
    weight: Tensor
    noise: Tensor


def pairs_of(
    captures: CaptureSet, rows: Sequence[Capture], model: Model, progress: Progress | None = None
) -> Pairs:
    """The pairs of some captures.

    Parameters
    ----------
    captures : CaptureSet
        The set.
    rows : sequence of Capture
        Captures of it; colours of one plane are stacked in the order of their patterns.
    model : Model
        With fitted gains.
    progress : callable or None
        Called with the share done.

    Raises
    ------
    InputError
        Where there is no capture, every picture is saturated, or the bench has more than three colours.
    """
    stacks = stacked(captures, rows)
    if not stacks:
        raise InputError(f"{captures.folder} has no captures to train on: capture some first")
    height, width = captures.bench.panel.shape
    shape = (len(stacks), len(captures.bench.channels), height, width)
    predicted, measured, weight, noise = (torch.zeros(shape, device="cpu") for _ in range(4))
    for k, stack in enumerate(stacks):
        for plane, capture in enumerate(stack):
            if capture is not None:
                one = measured_on_panel(model, load_batch(captures, [capture]))
                predicted[k, plane], measured[k, plane] = one.predicted.cpu(), one.measured.cpu()
                weight[k, plane], noise[k, plane] = one.weight.cpu(), one.noise.cpu()
        if progress:
            progress((k + 1) / len(stacks))
    counted = measured[weight > 0]
    if not len(counted):
        raise InputError(
            f"every picture of {captures.folder} is saturated: lower the exposure and capture again"
        )
    white = float(np.quantile(counted.numpy(), WHITE))
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


def measured_on_panel(model: Model, batch: Batch) -> PanelMeasurement:
    """Prediction and measurement of one capture (a batch of one) as irradiance on the panel's pixels."""
    scene, stages, expected, sensitivity = expected_counts(model, batch)
    sharp = sensitivity > DULL * sensitivity.max()
    safe = torch.where(sharp, sensitivity, 1.0)
    change = torch.where(sharp, (batch.signal - expected) / safe, 0.0)
    weight = batch.mask * sharp
    noise = batch.noise / safe**2
    shown = display_irradiance(model, batch)
    change, weight, noise = (onto_panel(scene, stages, one[0]) for one in (change, weight, noise))
    # a spline carries a pixel that does not count to its neighbours, with either sign: leave out all it reaches by 1 %
    weight = ((weight - 1).abs() < 0.01).to(change.dtype)
    return PanelMeasurement(shown, shown + change, weight, noise)


def expected_counts(model: Model, batch: Batch) -> tuple[Scene, Stages, Tensor, Tensor]:
    """Counts that a model expects of a capture (a batch of one), and their slope.

    Returns
    -------
    Scene, Stages
        Of the prediction.
    Tensor [1, h, w]
        Expected counts above black.
    Tensor [1, h, w]
        Sensitivity: counts per unit of irradiance.
    """
    predictor = Predictor(model, batch)
    scene, stages = predictor.scene, predictor.stages(model)
    with torch.no_grad():
        light = predictor.light(model, predictor.trace(model))
        gain = predictor.gain(model)
        if (own := predictor.own_gains(model, light)) is not None:
            gain, stages = gain * own, replace(stages, sensor=stages.sensor.as_bright(own))
    with torch.enable_grad():
        light.requires_grad_(True)
        expected = counts(scene, stages, light, gain, None)
        (sensitivity,) = torch.autograd.grad(expected.sum(), light)
    return scene, stages, expected.detach(), sensitivity.expand_as(expected)


def display_irradiance(model: Model, batch: Batch) -> Tensor:
    """Predicted irradiance of the display for the first pattern of a batch, on the panel's pixels [H, W]."""
    shown = acting_on_display(model)
    predictor = Predictor(shown, batch)
    with torch.no_grad():
        path = light_path(predictor.scene, predictor.stages(shown, 0))
        return pixel_irradiance(path, irradiance(path, panel_phase(path, batch.gray[:1])))[0]
