"""Patterns on a bench, virtual or real: shown, captured, and how similar the camera's pictures are to the targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from trainer.captures.acquire import acquire_captures
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_table import Capture
from trainer.captures.patterns import Pattern
from trainer.cycle.phase_retrieval import CARRIER, OPENING
from trainer.cycle.target_pictures import TargetVolume
from trainer.device import computing_on
from trainer.model.model import Model
from trainer.networks.lpips import Lpips
from trainer.training.image_metrics import ImageMetrics, image_metrics, mean_metrics
from trainer.training.training_pairs import Pairs, pairs_of


@dataclass(frozen=True)
class BenchDisplay:
    """A bench on which patterns are shown and captured.

    Attributes
    ----------
    headset : Headset
        Panel, lasers and camera.
    bench : Bench
        What is known of it.
    model : Model
        Under which the captures become irradiance; its effects on the camera are taken out of them.
    """

    headset: Any
    bench: Bench
    model: Model

    def show(
        self, patterns: Mapping[str, np.ndarray], planes_mm: tuple[float, ...], folder: Path
    ) -> CaptureSet:
        """Capture each pattern on each plane; the exposure is set again, once for each colour.

        Parameters
        ----------
        patterns : mapping of str to uint8 array [C, H, W]
            Gray levels by name; the captured patterns have these names.
        planes_mm : tuple of float, mm
            Distances of the planes.
        folder : path
            Of the new capture set.

        Raises
        ------
        InputError
            As from `acquire_captures`.
        """
        names = [c.name for c in self.bench.channels]

        def choose(channel: str, plane_mm: float) -> list[Pattern]:
            return [Pattern(name, gray[names.index(channel)]) for name, gray in patterns.items()]

        acquire_captures(self.headset, self.bench, folder, None, planes_mm, choose=choose)
        return read_captures(folder)


def headset_beside_zero_order(headset: Any) -> Any:
    """A virtual headset whose iris is next to the zero order, as in `beside_zero_order`.

    Raises
    ------
    InputError
        For a real headset: a person moves its iris.
    """
    from firmware_iface.virtual import VirtualHeadset
    from firmware_iface.virtual.defects import Iris

    if not isinstance(headset, VirtualHeadset):
        raise InputError(
            f"the iris of a real bench is moved by hand: put it {CARRIER:g} of the band off the axis along the "
            f"columns, {OPENING:g} of it to each side, and say so in the model, with the effect iris"
        )
    others = tuple(d for d in headset.description.defects if not isinstance(d, Iris))
    moved = Iris(half_width=OPENING, centre_x_share=0.0, centre_y_share=CARRIER)
    return VirtualHeadset(replace(headset.description, defects=(*others, moved)), headset.seed)


def pairs_by_pattern(captures: CaptureSet, model: Model) -> dict[str, Pairs]:
    """Pairs of each pattern of `BenchDisplay.show`, by its name."""
    names = dict.fromkeys(c.extra["kind"] for c in captures.captures)
    return {name: pairs_of(captures, rows_of(captures, name), model) for name in names}


def rows_of(captures: CaptureSet, name: str) -> list[Capture]:
    """Captures of one pattern of `BenchDisplay.show`, without the repeat that measures the noise."""
    unique = {(c.channel, c.plane_mm, c.pattern): c for c in captures.captures}
    return [c for c in unique.values() if c.extra["kind"] == name]


@computing_on("cpu")
def display_metrics(pairs: Pairs, wanted: TargetVolume, lpips: Lpips | None = None) -> ImageMetrics:
    """Metrics of the camera's pictures against a target, mean over its planes.

    They are of display-encoded pictures, with the target's brightest pixel as white, after one free scale for each
    colour and plane. Pixels that do not count, or that were not measured, are left out.
    """
    found = []
    for k in range(len(pairs)):
        target = torch.as_tensor(wanted.irradiance[k], dtype=torch.float32)
        weight = pairs.weight[k] * (torch.as_tensor(wanted.weight[k]) > 0)
        found.append(image_metrics(*_encoded(pairs.measured[k], target, weight), weight, lpips))
    return mean_metrics(found)


def _encoded(light: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Amplitudes [C, H, W] of the light, scaled to the target's, and of the target, whose brightest is 1."""
    root, wanted = torch.sqrt(light.clamp(min=0)), torch.sqrt(target)
    wanted = wanted / wanted.amax().clamp(min=1e-12)
    scale = (weight * root * wanted).sum((1, 2)) / (weight * root * root).sum((1, 2)).clamp(min=1e-12)
    return root * scale[:, None, None], wanted
