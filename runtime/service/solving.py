"""From a picture to patterns by a deadline: the one place where the service calls the solver."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runtime.bundle import read_bundle
from runtime.calibrated import bundle_channels, load_light_path
from runtime.lightpath import LightPath, irradiance, panel_phase, pixel_irradiance
from runtime.solver import solve

STEPS_AT_MOST = 40


@dataclass(frozen=True)
class Pattern:
    """Gray levels for every colour, uint8 [C, H, W], and what the calibrated model says that they show.

    psnr_db : of amplitude, of the worst colour. peak : irradiance of the brightest pixel over the mean.
    final : nothing better is to come by the deadline
    """

    gray: np.ndarray
    psnr_db: float
    peak: float
    final: bool


def light_paths(bundle: Path) -> list[LightPath]:
    """The light path of each colour of a bundle, in its order. Raises InputError for a broken one."""
    read = read_bundle(bundle)
    return [load_light_path(read, channel) for channel in bundle_channels(read)]


def patterns(paths: list[LightPath], target: np.ndarray, deadline_ns: int) -> Iterator[Pattern]:
    """Ever better patterns for a target irradiance [C, H, W]; the last one by the deadline (monotonic, ns).

    The first costs least and always comes. Raises InputError for a target that cannot be shown.
    """
    began = time.monotonic_ns()
    first = [solve(path, plane, 0) for path, plane in zip(paths, target, strict=True)]
    each_ns = time.monotonic_ns() - began
    steps = min(STEPS_AT_MOST, (deadline_ns - time.monotonic_ns()) // max(each_ns, 1) - 1)
    yield _pattern(paths, first, final=steps < 1)
    if steps >= 1:
        better = [
            solve(path, plane, int(steps), start=solution.phase)
            for path, plane, solution in zip(paths, target, first, strict=True)
        ]
        yield _pattern(paths, better, final=True)


def _pattern(paths: list[LightPath], solutions: list, final: bool) -> Pattern:
    gray = np.stack([solution.gray for solution in solutions])
    light = [
        pixel_irradiance(path, irradiance(path, panel_phase(path, s.gray.astype(np.int64))))
        for path, s in zip(paths, solutions, strict=True)
    ]
    peak = max(float(plane.max() / max(plane.mean(), 1e-30)) for plane in light)
    return Pattern(gray, min(s.quality.psnr_db for s in solutions), peak, final)
