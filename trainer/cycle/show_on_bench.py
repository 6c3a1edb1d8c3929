"""Patterns on a bench, virtual or real: shown, captured, and how near to what was wanted the camera saw them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from trainer.captures.acquire import capture_set
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import Capture, CaptureSet, read_captures
from trainer.captures.patterns import Pattern
from trainer.cycle.retrieval import CARRIER, OPENING, Volume
from trainer.model.model import Model
from trainer.networks.perceptual import Lpips
from trainer.training.likeness import Likeness, likeness, mean_likeness
from trainer.training.pairs import Pairs, pairs_of


@dataclass(frozen=True)
class Stage:
    """Where patterns are shown: a headset and what is known of its bench.

    model : of the display, with its gains; what it tells to the camera is taken out of what is seen
    """

    headset: Any
    bench: Bench
    model: Model

    def show(
        self, patterns: Mapping[str, np.ndarray], planes_mm: tuple[float, ...], folder: Path
    ) -> CaptureSet:
        """Capture each pattern [C, H, W] on each plane, as a capture set whose patterns bear the names.

        The exposure is set anew, once a colour. Raises InputError as `capture_set` does.
        """
        names = [c.name for c in self.bench.channels]

        def choose(channel: str, plane_mm: float) -> list[Pattern]:
            return [Pattern(name, gray[names.index(channel)]) for name, gray in patterns.items()]

        capture_set(self.headset, self.bench, folder, None, planes_mm, choose=choose)
        return read_captures(folder)


def with_iris_beside(headset: Any) -> Any:
    """A virtual headset whose iris stands beside the zero order, as `beside_zero_order` has it.

    Raises InputError for a real one: there a person moves the iris.
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


def seen_pairs(captures: CaptureSet, model: Model) -> dict[str, Pairs]:
    """What the camera saw of each pattern of `Stage.show`, by its name."""
    names = dict.fromkeys(c.extra["kind"] for c in captures.captures)
    return {name: pairs_of(captures, rows_of(captures, name), model) for name in names}


def rows_of(captures: CaptureSet, name: str) -> list[Capture]:
    """Captures of one pattern of `Stage.show`; the repeat that shows the noise is left out."""
    unique = {(c.channel, c.plane_mm, c.pattern): c for c in captures.captures}
    return [c for c in unique.values() if c.extra["kind"] == name]


def display_likeness(seen: Pairs, wanted: Volume, lpips: Lpips | None = None) -> Likeness:
    """How near what the camera saw is to a volume, mean over its planes.

    Of display-encoded pictures, the target's brightest as white, after one free scale a colour and plane; pixels that
    do not count, or that the camera did not see, are left out.
    """
    found = []
    for k in range(len(seen)):
        target = torch.as_tensor(wanted.irradiance[k], dtype=torch.float32)
        weight = seen.weight[k] * (torch.as_tensor(wanted.weight[k]) > 0)
        found.append(likeness(*_encoded(seen.measured[k], target, weight), weight, lpips))
    return mean_likeness(found)


def _encoded(light: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Amplitudes [C, H, W] of what was seen, scaled to the target's, and of the target, whose brightest is 1."""
    root, wanted = torch.sqrt(light.clamp(min=0)), torch.sqrt(target)
    wanted = wanted / wanted.amax().clamp(min=1e-12)
    scale = (weight * root * wanted).sum((1, 2)) / (weight * root * root).sum((1, 2)).clamp(min=1e-12)
    return root * scale[:, None, None], wanted
