"""A headset whose light has drifted from its bundle: a perfect bundle, and a bench with hidden defects."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np

from firmware_iface.virtual import BenchDescription, VirtualHeadset
from firmware_iface.virtual.defects import make_defect
from runtime.bundle.bundle_folder import INITIALISER, write_bundle
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.calibration.estimate import ColourLightPath, Shot, shot_of
from runtime.headset.open_devices import Devices
from runtime.lightpath.legendre import edge_to_edge
from tests.runtime.benches import ideal_path

SHAPE, DISTANCE_MM, WAVELENGTH_NM = (96, 128), 8.0, 520.0


def drifted_bench(*defects: str, shape: tuple[int, int] = SHAPE, **parameters: float) -> BenchDescription:
    """A bench with defects of their default sizes; parameters go to the first."""
    made = [make_defect(kind, **(parameters if n == 0 else {})) for n, kind in enumerate(defects)]
    return BenchDescription(defects=tuple(made)).resized(*shape, DISTANCE_MM)


def headset(bench: BenchDescription, seed: int = 1) -> VirtualHeadset:
    return VirtualHeadset(bench, seed)


def devices(headset: VirtualHeadset) -> Devices:
    return Devices(headset.panel, headset.lasers, headset.camera, {}, headset.move_to_plane)


def opened(headset: VirtualHeadset) -> Callable[[], AbstractContextManager[Devices]]:
    """A function that opens an existing headset."""
    return lambda: nullcontext(devices(headset))


def base(shape: tuple[int, int] = SHAPE) -> ColourLightPath:
    """The light path of the bundle: a perfect one."""
    return ColourLightPath(ideal_path(shape, DISTANCE_MM * 1e-3, dtype=np.float32), WAVELENGTH_NM)


def blank(gray: np.ndarray, channel: str = "green") -> Shot:
    """A pattern without a picture, to be predicted."""
    nothing = np.zeros((1, 1), np.float32)
    return shot_of(channel, gray, nothing, 0.0, nothing)


def ideal_bundle(folder: Path, shape: tuple[int, int] = SHAPE, slow_share: float = 0.0) -> Path:
    records, arrays = pack_light_paths([("green", DISTANCE_MM, WAVELENGTH_NM, base(shape).path)])
    networks = {INITIALISER: b"a network that calibration does not read"}
    panel = {"panel": {"slow_response_share": slow_share}} if slow_share else {}
    described = {"paths": records, "distance_mm": DISTANCE_MM, **panel}
    write_bundle(folder, arrays, described, {"bench": "ideal"}, networks=networks)
    return folder


def without_tilt(surface: np.ndarray) -> np.ndarray:
    """A map [H, W] less its best plane, which at one plane looks the same as a camera that has moved."""
    y, x = edge_to_edge(surface.shape)
    plane = np.stack([np.ones(surface.size), y.ravel(), x.ravel()], 1)
    flat = surface.ravel()
    return (flat - plane @ np.linalg.lstsq(plane, flat, rcond=None)[0]).reshape(surface.shape)
