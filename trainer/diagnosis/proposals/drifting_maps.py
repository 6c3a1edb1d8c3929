"""Maps whose strength changes from capture to capture, and how strong a shape is in each: tasks for any process.

The gradient of a capture's squared error by a stage's free map is the map that is missing there, and noise that
differs from pattern to pattern. What all captures share is no matter here. Of the rest, the strongest common map is the
first principal component of the captures' gradients: its strengths are free in each capture, so it is seen whatever
function of the order or the time they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from runtime.excess import joined
from trainer.captures.batches import load
from trainer.captures.capture_set import chosen, opened
from trainer.device import array_of
from trainer.diagnosis.proposals.order_shape import Strengths
from trainer.diagnosis.proposals.probe_maps import (
    AMPLITUDE,
    DELAY,
    GAIN,
    GRAY,
    OFFSET,
    PASSED,
    PHASE,
    TRANSMISSION,
    Place,
    outside_band,
)
from trainer.fitting.free_form_maps import FreeFormBatch
from trainer.model.model import Model
from trainer.prediction.free_stages import FreeFormStage, Tensors, learned_stage

# Free maps of a stage that an effect could replace; two are the parts of a complex one.
FREE = {
    AMPLITUDE: ("log_amplitude",),
    PHASE: ("phase",),
    TRANSMISSION: ("log_amplitude", "phase"),
    GAIN: ("gain",),
    OFFSET: ("offset",),
    PASSED: ("log",),
    DELAY: ("phase",),
    GRAY: ("table",),
}
STANDS_OUT = 3.0  # times the middle component: what the first one must have, or it is noise
SMALL = 0.05  # largest value of a map in a derivative's step

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DriftingMap:
    """The strongest map of a place whose strength changes from capture to capture.

    Attributes
    ----------
    place : Place
    values : array
        On the free map's nodes, in the place's unit, of arbitrary size; complex for TRANSMISSION.
    """

    place: Place
    values: Array


@torch.no_grad()
def drifting_maps(folder: Path, ids: tuple[str, ...], model: Model, stage: str) -> list[DriftingMap]:
    """The maps of a stage whose strength changes from capture to capture; none where only noise does.

    Parameters
    ----------
    folder : Path
        Of the capture set.
    model : Model
        With fitted gains.
    """
    free = learned_stage(model.bench, stage)
    names = sorted({n for place in _places(stage) for n in FREE[place]})
    captures = opened(folder)
    rows: dict[str, list[Array]] = {n: [] for n in names}
    for batch in load(captures, chosen(captures, ids)):
        one = FreeFormBatch(model, batch)
        for k in range(len(batch.ids)):
            for name, gradient in _gradients(free, one, k, names).items():
                rows[name].append(gradient)
    found = []
    for place in _places(stage):
        parts = [np.stack(rows[n]) for n in FREE[place]]
        table = np.concatenate([p.reshape(len(p), -1) for p in parts], axis=1)
        table = table - table.mean(axis=0)
        sizes, strengths = np.linalg.eigh(table @ table.T)
        if sizes[-1] > STANDS_OUT * np.median(sizes[1:]):
            maps = [-np.tensordot(strengths[:, -1], p, axes=1) for p in parts]
            found.append(DriftingMap(place, _as_place(place, maps, model)))
    return found


@torch.no_grad()
def strengths_of(
    folder: Path, ids: tuple[str, ...], model: Model, place: Place, shape: Array
) -> tuple[Strengths, float]:
    """How strong a small shape is in each capture, by least squares along the prediction's derivative.

    Parameters
    ----------
    shape : array
        On the nodes of the place's map.

    Returns
    -------
    Strengths
    float, counts^2
        Variance of the signal, summed over the pixels of all captures, in whose share the weights become excess.
    """
    free = learned_stage(model.bench, place.stage)
    maps = _as_free(place, shape, free, model)
    step = SMALL / max(1e-30, max(float(m.abs().max()) for m in maps.values()))
    captures = opened(folder)
    moments, values, weights, errors = [], [], [], []
    for batch in load(captures, chosen(captures, ids)):
        one = FreeFormBatch(model, batch)
        for k in range(len(batch.ids)):
            base = one.predict(free, _at(free, maps, 0.0), k)
            slope = (one.predict(free, _at(free, maps, step), k) - base) / step
            mask = batch.mask[k : k + 1]
            slope, left, like = (
                (mask * a).reshape(-1).double() for a in (slope, batch.signal[k : k + 1] - base, base)
            )
            # How bright the capture is as a whole is not the shape's.
            slope, left = (a - like * ((a @ like) / (like @ like)) for a in (slope, left))
            weight = float(slope @ slope)
            moments.append(batch.moments[k])
            weights.append(max(weight, 1e-30))
            values.append(float(slope @ left) / max(weight, 1e-30))
        errors.append(batch.errors(torch.zeros_like(batch.signal)))
    return Strengths(tuple(moments), np.array(values), np.array(weights)), float(
        joined(errors).variance.sum()
    )


def _places(stage: str) -> list[Place]:
    return [place for place in FREE if place.stage == stage]


def _gradients(free: FreeFormStage, one: FreeFormBatch, k: int, names: list[str]) -> dict[str, Array]:
    """Gradients of capture k's squared error by the free maps at zero, a unit of its light."""
    zero = {n: torch.zeros(shape, requires_grad=n in names) for n, (shape, _) in free.shapes.items()}
    with torch.enable_grad():
        error = one.squared_error(free, zero, k)
        slopes = torch.autograd.grad(error, [zero[n] for n in names])
    light = float((one.weight[k] * one.batch.signal[k] ** 2).sum())
    return {n: array_of((s / light).double()) for n, s in zip(names, slopes, strict=True)}


def _at(free: FreeFormStage, maps: Mapping[str, torch.Tensor], size: float) -> Tensors:
    """Free maps with these at some size, and zero for the others."""
    return {n: size * maps[n] if n in maps else torch.zeros(s) for n, (s, _) in free.shapes.items()}


def _as_place(place: Place, maps: list[Array], model: Model) -> Array:
    """A map of a place from the free maps."""
    if place is TRANSMISSION:
        return np.asarray(maps[0] + 1j * maps[1])
    if place is GRAY:
        return np.asarray(maps[0].mean(axis=0))
    return maps[0] * (model.bench.camera.full_scale if place is OFFSET else 1.0)


def _as_free(place: Place, shape: Array, free: FreeFormStage, model: Model) -> dict[str, torch.Tensor]:
    """Free maps that are a small map of a place."""
    parts = [shape.real, shape.imag] if place is TRANSMISSION else [shape]
    if place is OFFSET:
        parts = [parts[0] / model.bench.camera.full_scale]
    found = {}
    for name, part in zip(FREE[place], parts, strict=True):
        nodes = free.shapes[name][0]
        if place is GRAY:
            part = np.broadcast_to(part, nodes)
        elif part.shape != nodes:
            part = np.pad(part, [(n, n) for n in outside_band(nodes)])
        found[name] = torch.as_tensor(np.array(part), dtype=torch.float32)
    return found
