"""Pictures to show: a user's, or photographs that are at hand, as irradiance [C, H, W]."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from firmware_iface.errors import InputError
from runtime.solver.targets import CHANNELS, decode_srgb, fit_area, read_target
from trainer.captures.bench_file import Bench
from trainer.cycle.retrieval import Volume

LEARNED = ("camera", "coins", "text", "chelsea", "page", "moon", "brick", "rocket")
HELD_OUT = ("astronaut", "coffee")
DARKEST = 0.002  # of white: no display is darker


def volumes_of(paths: Sequence[Path], bench: Bench, plane_mm: float | None = None) -> list[Volume]:
    """Picture files, cut and resized to the panel, on one plane. Raises InputError as `read_target` does."""
    plane = bench.distance_mm if plane_mm is None else plane_mm
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        raise InputError("two pictures have one name: rename one, since their patterns are named after them")
    colours = [c.name for c in bench.channels]
    of_light = colours if set(colours) <= set(CHANNELS) and len(colours) > 1 else None
    found = []
    for path in paths:
        picture = read_target(path, bench.panel.shape, of_light or 1, fit=True)
        planes = picture if of_light else np.repeat(picture[None], len(colours), 0)
        found.append(Volume.flat(path.stem, plane, planes))
    return found


def photographs(names: Sequence[str], bench: Bench, mirrored: bool = False) -> list[Volume]:
    """Photographs that scikit-image ships, in the bench's plane; `mirrored` adds each one left to right."""
    found = []
    for name in names:
        picture = _photograph(name, bench)
        found.append(Volume.flat(name, bench.distance_mm, picture))
        if mirrored:
            turned = np.ascontiguousarray(picture[..., ::-1])
            found.append(Volume.flat(f"{name}-mirrored", bench.distance_mm, turned))
    return found


def in_depth(flat: Volume, planes_mm: Sequence[float], depth: np.ndarray | None = None) -> Volume:
    """A picture in depth: each pixel is in focus, and counts, on the plane that its depth falls to.

    depth : [H, W], 0 (the first plane) .. 1 (the last); none: rising from left to right, so planes are upright strips
    """
    shape, count = flat.irradiance.shape[-2:], len(planes_mm)
    if depth is None:
        depth = np.broadcast_to((np.arange(shape[1]) + 0.5) / shape[1], shape)
    nearest = np.minimum((count * depth).astype(int), count - 1)
    weight = np.stack([nearest == k for k in range(count)]).astype(np.float32)
    return Volume(flat.name, tuple(planes_mm), np.repeat(flat.irradiance, len(planes_mm), 0), weight)


def _photograph(name: str, bench: Bench) -> np.ndarray:
    from skimage import data

    pixels = np.asarray(getattr(data, name)())
    pixels = np.repeat(pixels[..., None], 3, -1) if pixels.ndim == 2 else pixels[..., :3]
    light = np.moveaxis(decode_srgb(pixels / 255), -1, 0)
    planes = [CHANNELS.index(c.name) if c.name in CHANNELS else 1 for c in bench.channels]
    return np.maximum(fit_area(light[planes], bench.panel.shape), DARKEST).astype(np.float32)
