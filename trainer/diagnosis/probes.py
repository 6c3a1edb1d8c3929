"""Free-form probes: the most general thing each stage could be doing, fitted alone.

The stage whose probe removes most of the held-out excess is where the missing physics is, also when no named
effect fits. A fitted probe is a picture that shows a fringe, a speck or a stripe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from runtime.excess import PredictionErrors, RemovedExcess, joined, removed_excess
from runtime.lightpath.legendre import legendre_count, legendre_curve, legendre_surface
from runtime.lightpath.light_path import mode_irradiance, panel_phase, panel_spectrum, states
from trainer.captures.batches import Batch, load, load_batch
from trainer.captures.capture_set import chosen, opened
from trainer.captures.held_out import with_stopping
from trainer.fitting.free_form_maps import FreeFormBatch, FreeFormStage, MapPicture, Tensors, descend
from trainer.model.model import Model
from trainer.prediction.panel_field import UNITS, resized, with_field
from trainer.prediction.predict import light_path
from trainer.prediction.scene import Scene, Stages

ROUND = 2  # iterations between two checks of the captures that say when to stop
ROUNDS = {"drive": 7, "panel": 12, "pupil": 10, "sensor": 12}
CAPTURES = {"drive": 4, "panel": 8, "pupil": 6, "sensor": 8}  # most that the gradient sees
NODES = {"panel": 80_000, "sensor": 9_000}  # most nodes of a free map; larger pictures get coarser maps
PUPIL_NODES = 97  # nodes of the pupil's map across its extent, an axis
PUPIL_EXTENT = 1.3  # of the panel's band
KNOTS = 33
SMOOTH_ORDER = 6
TAPS = 9  # of the sensor's free kernel, half a pixel apart


@dataclass(frozen=True)
class ProbeFit:
    """A fitted probe.

    Attributes
    ----------
    stage : str
    held_out : PredictionErrors
        Errors with the probe on the held-out captures.
    pictures : tuple of MapPicture
        Its maps.
    """

    stage: str
    held_out: PredictionErrors
    pictures: tuple[MapPicture, ...]


@dataclass(frozen=True)
class ProbeResult:
    """A probe judged against the model without it.

    Attributes
    ----------
    removed : RemovedExcess
        Held-out excess that the probe removes.
    excess_after : float
        Held-out excess with the probe.
    """

    stage: str
    removed: RemovedExcess
    excess_after: float
    pictures: tuple[MapPicture, ...]

    @classmethod
    def judged(cls, found: ProbeFit, before: PredictionErrors) -> ProbeResult:
        """How much held-out excess the probe removes."""
        return cls(found.stage, removed_excess(before, found.held_out), found.held_out.excess, found.pictures)

    def as_json(self) -> dict[str, Any]:
        """A row of the key `stages` of `diagnose --json`: `stage`, `excess_removed`, `excess_after` and `ci95`."""
        low, high = self.removed.interval()
        return {
            "stage": self.stage,
            "excess_removed": self.removed.value,
            "excess_after": self.excess_after,
            "ci95": [low, high],
        }


def probe(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, stage: str
) -> ProbeFit:
    """Fit one stage's probe on some captures and judge it on others.

    Parameters
    ----------
    folder : Path
        Of the capture set.
    ids, held_ids : tuple of str
        Captures to fit, and captures to judge by.
    model : Model
        With fitted gains.
    """
    captures = opened(folder)
    rows = chosen(captures, ids)
    first, last = with_stopping(rows, CAPTURES[stage])
    batches = load(captures, first)
    free = PROBES[stage](model, batches[0])
    scale = sum(float(b.errors(torch.zeros_like(b.signal)).variance.sum()) for b in batches)
    # One capture a colour and plane is kept from the gradient and says when to stop.
    fitted, stopping = ([FreeFormBatch(model, b) for b in part] for part in (batches, load(captures, last)))
    found = descend(free, fitted, stopping, scale, ROUND, ROUNDS[stage])
    with torch.no_grad():
        parts = []
        for row in chosen(captures, held_ids):
            held = FreeFormBatch(model, load_batch(captures, [row]))
            parts.append(held.batch.errors(held.predict(free, found, 0)))
        return ProbeFit(stage, joined(parts), tuple(free.pictures(found)))


def _drive(model: Model, batch: Batch) -> FreeFormStage:
    y, x = _field(*model.bench.panel.shape)
    channels = [c.name for c in model.bench.channels]
    taps = torch.tensor([[0.0, 0, 1, 0, 0], [0, 0, 1, 0, 0]])

    def apply(stages: Stages, t: Tensors) -> Stages:
        drive = stages.drive
        knots = t["table"][channels.index(drive.channel)]
        bend = _interpolated(knots, drive.level * (drive.level.shape[0] / 256))
        moved = replace(drive, response=drive.response + bend)
        moved = moved.scaled(1 + legendre_surface(t["gain"], y, x))
        if drive.crosstalk is None:
            moved = replace(moved, crosstalk=(taps + t["rows"], taps + t["columns"]))
        return replace(stages, drive=moved)

    def pictures(t: Tensors) -> list[MapPicture]:
        gain = legendre_surface(t["gain"], y, x)
        return [
            *((f"response, deviation ({c})", _array(t["table"][k]), "rad") for k, c in enumerate(channels)),
            ("gain of the phase over the panel", _array(gain), "relative"),
            ("share of neighbours, rows then columns", _array(torch.cat((t["rows"], t["columns"]))), "1"),
        ]

    shapes = {
        "table": ((len(channels), KNOTS), math.sqrt(KNOTS) / 4),
        "gain": ((legendre_count(SMOOTH_ORDER),), 0.5),
        "rows": ((2, 5), 0.5),
        "columns": ((2, 5), 0.5),
        "spread": ((), 0.3),
    }
    return FreeFormStage("drive", shapes, apply, pictures, irradiance=_spread_in_time)


def _spread_in_time(scene: Scene, stages: Stages, gray: Tensor, tensors: Tensors) -> Tensor:
    """Mean irradiance over a phase whose gain swings by +-`spread` during the exposure."""
    path = light_path(scene, stages)
    phase = panel_phase(path, gray)
    swings = [phase * (1 + s * tensors["spread"]) for s in (-1, 1)]
    parts = [(state, swing) for state in states(path) for swing in swings]
    return 0.5 * sum(mode_irradiance(state, panel_spectrum(state, swing)) for state, swing in parts)


def _panel(model: Model, batch: Batch) -> FreeFormStage:
    height, width = model.bench.panel.shape
    nodes = _nodes(height, width, "panel")
    unit = math.sqrt(nodes[0] * nodes[1])

    def apply(stages: Stages, t: Tensors) -> Stages:
        return replace(stages, panel=with_field(stages.panel, t))

    def pictures(t: Tensors) -> list[MapPicture]:
        added = torch.hypot(t["added_real"], t["added_imaginary"])
        return [
            ("amplitude multiplied", _array(torch.exp(t["log_amplitude"])), "relative"),
            ("phase multiplied", _array(t["phase"]), "rad"),
            ("amplitude added", _array(added), "of the modulated"),
        ]

    return FreeFormStage("panel", {n: (nodes, unit) for n in UNITS}, apply, pictures)


def _pupil(model: Model, batch: Batch) -> FreeFormStage:
    def apply(stages: Stages, t: Tensors) -> Stages:
        pupil = stages.pupil
        log = _sampled(t["log"], pupil.v / PUPIL_EXTENT, pupil.u / PUPIL_EXTENT)
        phase = _sampled(t["phase"], pupil.v / PUPIL_EXTENT, pupil.u / PUPIL_EXTENT)
        phase = phase * (pupil.reference_wavelength / pupil.wavelength)
        size = torch.exp(torch.clamp(log, -4, 2))
        factor = torch.complex(size * torch.cos(phase), size * torch.sin(phase))
        before = pupil.transmission
        moved = replace(pupil, transmission=factor if before is None else before * factor)
        reach = (2 * math.pi * 1e-3 * torch.abs(pupil.distance)) ** 2
        rows, columns = t["extent"]
        blur = torch.exp(-0.5 * reach * (rows * pupil.iy**2 + columns * pupil.ix**2))
        return replace(stages, pupil=moved.filtered(blur))

    def pictures(t: Tensors) -> list[MapPicture]:
        return [
            ("amplitude passed, over spatial frequency", _array(torch.exp(t["log"])), "relative"),
            ("phase, over spatial frequency", _array(t["phase"]), "rad"),
        ]

    nodes = (PUPIL_NODES, PUPIL_NODES)
    shapes = {"log": (nodes, PUPIL_NODES), "phase": (nodes, PUPIL_NODES), "extent": ((2,), 0.5)}
    return FreeFormStage("pupil", shapes, apply, pictures)


def _sensor(model: Model, batch: Batch) -> FreeFormStage:
    height, width = model.bench.camera.shape
    nodes = _nodes(height, width, "sensor")
    full_scale = model.bench.camera.full_scale
    y, x = _field(height, width)
    reach = (torch.arange(TAPS) - TAPS // 2) / 2

    def apply(stages: Stages, t: Tensors) -> Stages:
        sensor = stages.sensor
        gain = torch.exp(torch.clamp(resized(t["gain"], (height, width)), -3, 3))
        moved = replace(sensor, free_capture_gain=True).multiplied(gain)
        moved = moved.brightened(full_scale * resized(t["offset"], (height, width)))
        moved = moved.displaced(*(legendre_surface(t["shift"][k], y, x, 0) for k in (0, 1)))
        kernel = t["kernel"]
        rows = 2 * math.pi * sensor.iy * reach
        columns = 2 * math.pi * sensor.ix.T * reach
        real = (
            torch.cos(rows) @ kernel @ torch.cos(columns).T - torch.sin(rows) @ kernel @ torch.sin(columns).T
        )
        odd = -(
            torch.sin(rows) @ kernel @ torch.cos(columns).T + torch.cos(rows) @ kernel @ torch.sin(columns).T
        )
        moved = moved.blurred(torch.complex(1 + real, odd))

        def curve(share: Tensor) -> Tensor:
            inside = torch.clamp(share, -0.05, 1)
            return share + inside * (1 - inside) * torch.tensordot(
                t["bend"], legendre_curve(2 * inside - 1, t["bend"].shape[0]), dims=1
            )

        return replace(stages, sensor=moved.responding(curve))

    def pictures(t: Tensors) -> list[MapPicture]:
        shift = [legendre_surface(t["shift"][k], y, x, 0) for k in (0, 1)]
        share = torch.linspace(0, 1, 101)
        bend = share * (1 - share) * (t["bend"] @ legendre_curve(2 * share - 1, t["bend"].shape[0]))
        return [
            ("gain over the picture", _array(torch.exp(t["gain"])), "relative"),
            ("light added", _array(full_scale * t["offset"]), "counts"),
            ("displacement, rows", _array(shift[0]), "pixels"),
            ("displacement, columns", _array(shift[1]), "pixels"),
            ("kernel, half-pixel steps", _array(t["kernel"]), "1"),
            ("response, deviation", _array(bend), "of full scale"),
        ]

    unit = math.sqrt(nodes[0] * nodes[1])
    shapes = {
        "gain": (nodes, unit),
        "offset": (nodes, 0.1 * unit),
        "shift": ((2, legendre_count(3, 0)), 2.0),
        "kernel": ((TAPS, TAPS), 0.5),
        "bend": ((6,), 1.0),
    }
    return FreeFormStage("sensor", shapes, apply, pictures)


PROBES: dict[str, Callable[[Model, Batch], FreeFormStage]] = {
    "drive": _drive,
    "panel": _panel,
    "pupil": _pupil,
    "sensor": _sensor,
}


def _array(values: Tensor) -> np.ndarray:
    return values.detach().float().numpy()


def _field(height: int, width: int) -> tuple[Tensor, Tensor]:
    y, x = ((torch.arange(n) - (n - 1) / 2) / (n / 2) for n in (height, width))
    return torch.broadcast_tensors(y[:, None], x[None, :])


def _nodes(height: int, width: int, stage: str) -> tuple[int, int]:
    shrink = max(1.0, math.sqrt(height * width / NODES[stage]))
    return round(height / shrink), round(width / shrink)


def _sampled(nodes: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """A map given by nodes over -1 .. 1, at y [n, 1] and x [1, m]: bilinear, as two small matrix products."""
    return _tents(y[:, 0], nodes.shape[0]) @ nodes @ _tents(x[0, :], nodes.shape[1]).T


def _tents(position: Tensor, count: int) -> Tensor:
    place = torch.clamp((position + 1) / 2 * (count - 1), 0, count - 1)
    return torch.clamp(1 - torch.abs(place[:, None] - torch.arange(count)), min=0)


def _interpolated(knots: Tensor, share: Tensor) -> Tensor:
    return _tents(2 * share - 1, knots.shape[0]) @ knots
