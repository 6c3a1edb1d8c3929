"""The most general thing that each stage of the light path could be doing: free-form maps and curves.

The probes fit them to see which stage lacks something. What has no name in the end is learned as one of them, and is
then a part of the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from runtime.lightpath.legendre import legendre_count, legendre_curve, legendre_surface
from runtime.lightpath.light_path import mode_irradiance, panel_phase, panel_spectrum, states
from trainer.captures.bench_file import Bench
from trainer.device import array_of
from trainer.kept_results import kept_by_device
from trainer.prediction.panel_field import UNITS, resized, with_field
from trainer.prediction.predict import light_path
from trainer.prediction.scene import Scene, Stages

MapPicture = tuple[str, np.ndarray, str]  # title, values, unit
Tensors = dict[str, Tensor]

NODES = {"panel": 80_000, "sensor": 9_000}  # most nodes of a free map; larger pictures get coarser maps
PUPIL_NODES = 97  # nodes of the pupil's map across its extent, an axis
PUPIL_EXTENT = 1.3  # of the panel's band, each way: as far as a map over the pupil reaches
KNOTS = 33
SMOOTH_ORDER = 6
TAPS = 9  # of the sensor's free kernel, half a pixel apart


@dataclass(frozen=True)
class FreeFormStage:
    """The maps that are free at a stage.

    Attributes
    ----------
    stage : str
        The first stage that the maps change.
    shapes : dict
        {name: (shape, physical units a unit of the optimiser's variable)}.
    apply : callable
        `(stages, maps) -> stages`.
    pictures : callable
        `maps -> [(title, array, unit)]`.
    prior : mapping
        {name: expected standard deviation, physical units}, where squared errors are in units of their variance.
    irradiance : callable, optional
        `(scene, stages, gray [1, H, W], maps) -> irradiance`, where the stages alone do not determine the light; the
        light path's own otherwise.
    """

    stage: str
    shapes: dict[str, tuple[tuple[int, ...], float]]
    apply: Callable[[Stages, Tensors], Stages]
    pictures: Callable[[Tensors], list[MapPicture]]
    prior: Mapping[str, float] = field(default_factory=dict)
    irradiance: Callable[[Scene, Stages, Tensor, Tensors], Tensor] | None = None


def _drive(bench: Bench) -> FreeFormStage:
    y, x = _field(*bench.panel.shape)
    channels = [c.name for c in bench.channels]
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


def _panel(bench: Bench) -> FreeFormStage:
    height, width = bench.panel.shape
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


def _pupil(bench: Bench) -> FreeFormStage:
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


def _sensor(bench: Bench) -> FreeFormStage:
    height, width = bench.camera.shape
    nodes = _nodes(height, width, "sensor")
    full_scale = bench.camera.full_scale
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


FREE_STAGES: dict[str, Callable[[Bench], FreeFormStage]] = {
    "drive": _drive,
    "panel": _panel,
    "pupil": _pupil,
    "sensor": _sensor,
}


def _array(values: Tensor) -> np.ndarray:
    return array_of(values.float())


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


LEARNED = "learned"  # table of a model file
LEARNED_STAGES = ("drive", "pupil", "sensor")  # what is learned at the panel is its field (`panel_field`)


@kept_by_device(8)
def learned_stage(bench: Bench, stage: str) -> FreeFormStage:
    """What may be learned at a stage: its free form, as far as it is one light path."""
    free = FREE_STAGES[stage](bench)
    shapes = {n: s for n, s in free.shapes.items() if free.irradiance is None or n != "spread"}
    return replace(free, shapes=shapes, irradiance=None)


def with_learned(stages: Stages, bench: Bench, stage: str, maps: Mapping[str, np.ndarray]) -> Stages:
    """The stages with what was learned at one of them.

    Parameters
    ----------
    maps : mapping of str to float array
        Of the names and shapes that `learned_stage` gives.
    """
    dtype = stages.drive.response.dtype
    tensors = {name: torch.as_tensor(array, dtype=dtype) for name, array in maps.items()}
    return learned_stage(bench, stage).apply(stages, tensors)
