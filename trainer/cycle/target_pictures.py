"""Targets of the cycle: a user's pictures or photographs that scikit-image ships, on one plane or in depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_iface.errors import InputError
from runtime.solver.targets import CHANNELS, fit_area, read_target
from trainer.captures.bench_file import Bench
from trainer.training.photographs import photograph

LEARNED = ("camera", "coins", "text", "chelsea", "page", "moon", "brick", "rocket")
HELD_OUT = ("astronaut", "coffee")
DARKEST = 0.002  # of white: no display is darker


@dataclass(frozen=True)
class TargetVolume:
    """What is to be shown: irradiance on K planes.

    Attributes
    ----------
    name : str
        Of its patterns and captures.
    planes_mm : tuple of float, mm
        Distances of the K planes from the panel.
    irradiance : array [K, C, H, W]
        Of any scale.
    weight : array [K, H, W]
        How much a pixel of a plane counts. A scene in depth counts each pixel where it is in focus.
    """

    name: str
    planes_mm: tuple[float, ...]
    irradiance: np.ndarray
    weight: np.ndarray

    @staticmethod
    def flat(name: str, plane_mm: float, picture: np.ndarray) -> TargetVolume:
        """A picture [C, H, W] on one plane."""
        return TargetVolume(name, (plane_mm,), picture[None], np.ones((1, *picture.shape[1:]), np.float32))


def volumes_of(paths: Sequence[Path], bench: Bench, plane_mm: float | None = None) -> list[TargetVolume]:
    """Picture files, cut and resized to the panel, on one plane.

    Raises
    ------
    InputError
        Where two files have one name, and as from `read_target`.
    """
    plane = bench.distance_mm if plane_mm is None else plane_mm
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        raise InputError("two pictures have one name: rename one, since their patterns are named after them")
    colours = [c.name for c in bench.channels]
    coloured = colours if set(colours) <= set(CHANNELS) and len(colours) > 1 else None
    found = []
    for path in paths:
        picture = read_target(path, bench.panel.shape, coloured or 1, fit=True)
        planes = picture if coloured else np.repeat(picture[None], len(colours), 0)
        found.append(TargetVolume.flat(path.stem, plane, planes))
    return found


def photographs(names: Sequence[str], bench: Bench, mirrored: bool = False) -> list[TargetVolume]:
    """Photographs that scikit-image ships, in the bench's plane; `mirrored` adds each one left to right."""
    found = []
    for name in names:
        planes = [CHANNELS.index(c.name) if c.name in CHANNELS else 1 for c in bench.channels]
        light = fit_area(photograph(name)[planes], bench.panel.shape)
        picture = np.maximum(light, DARKEST).astype(np.float32)
        found.append(TargetVolume.flat(name, bench.distance_mm, picture))
        if mirrored:
            mirror = np.ascontiguousarray(picture[..., ::-1])
            found.append(TargetVolume.flat(f"{name}-mirrored", bench.distance_mm, mirror))
    return found


def in_depth(flat: TargetVolume, planes_mm: Sequence[float], depth: np.ndarray | None = None) -> TargetVolume:
    """A picture in depth: each pixel is in focus, and counts, on the plane that its depth falls to.

    Parameters
    ----------
    flat : TargetVolume
        A picture on one plane.
    planes_mm : sequence of float, mm
        Distances of the planes.
    depth : array [H, W] or None
        0 (the first plane) .. 1 (the last). None rises from left to right, so that planes are upright strips.
    """
    shape, count = flat.irradiance.shape[-2:], len(planes_mm)
    if depth is None:
        depth = np.broadcast_to((np.arange(shape[1]) + 0.5) / shape[1], shape)
    nearest = np.minimum((count * depth).astype(int), count - 1)
    weight = np.stack([nearest == k for k in range(count)]).astype(np.float32)
    return TargetVolume(flat.name, tuple(planes_mm), np.repeat(flat.irradiance, len(planes_mm), 0), weight)
