"""Captures that say nothing: no light above the camera's noise, or no pixel below saturation.

A fit to such a capture only finds that the light was off, and takes that for a drift of the laser.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Camera
from trainer.captures.camera_noise import noise_variance
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.png_reader import read_picture

NOISE_FACTOR = 1.5  # variance of the counts over the expected noise's, up to which there is no picture
DARK_COUNTS = 3.0  # mean above black up to which there is no light, counts; or
DARK_SIGMAS = 2.0  # standard deviations of a dark pixel, whichever is more

DARK = "no light above the camera's noise"
SATURATED = "every pixel saturated"


def fault_of(counts: np.ndarray, camera: Camera) -> str:
    """Why one picture says nothing about the light path.

    A picture is dark where the mean of its unsaturated pixels is about black and their variance is no more than the
    camera's noise gives. A bright picture without contrast is not: it tells how bright the light is.

    Parameters
    ----------
    counts : uint16 array [h, w], raw counts
    camera : Camera

    Returns
    -------
    str
        DARK, SATURATED, or "" where the picture can be used (or has counts that the camera cannot give, which is
        another fault).
    """
    if counts.max() > camera.saturation:
        return ""
    used = counts[counts < camera.saturation]
    if not used.size:
        return SATURATED
    signal = used.astype(np.float64) - camera.black_level
    limit = max(DARK_COUNTS, DARK_SIGMAS * math.sqrt(float(noise_variance(0.0, camera))))
    if float(signal.mean()) > limit:
        return ""
    return DARK if float(signal.var()) <= NOISE_FACTOR * float(noise_variance(signal, camera).mean()) else ""


def with_signal(captures: CaptureSet) -> tuple[list[Capture], dict[str, str]]:
    """The captures of a set that say something, and why each of the others does not.

    Returns
    -------
    list of Capture
        In the order of the set.
    dict
        By the id of a capture that is left out: DARK or SATURATED.

    Raises
    ------
    InputError
        Where no capture is left.
    """
    camera = captures.bench.camera
    faults = {c.capture: _fault(c, camera) for c in captures.captures}
    kept = [c for c in captures.captures if not faults[c.capture]]
    if not kept:
        raise InputError(_nothing_to_see(captures, list(faults.values())))
    return kept, {name: fault for name, fault in faults.items() if fault}


def _fault(capture: Capture, camera: Camera) -> str:
    """As `fault_of`; of a bracket, "" where one frame can be used, and else the shortest's.

    Also "" for a picture that cannot be read: whoever uses it reports that.
    """
    try:
        files = [(row.image, row.image.stat()) for row in capture.rows]
        faults = [_fault_in(path, about.st_mtime_ns, about.st_size, camera) for path, about in files]
    except (OSError, InputError):
        return ""
    return "" if "" in faults else faults[0]


@lru_cache(maxsize=100_000)
def _fault_in(path: Path, changed: int, size: int, camera: Camera) -> str:
    return fault_of(read_picture(path, camera.shape, 16 if camera.bit_depth > 8 else 0, "the image"), camera)


def _nothing_to_see(captures: CaptureSet, faults: Sequence[str]) -> str:
    """The refusal of a set in which every capture says nothing, in one line."""
    if all(fault == SATURATED for fault in faults):
        return f"every picture of {captures.folder} is saturated: lower the exposure and capture again"
    what = (
        "no light above the camera's noise"
        if all(fault == DARK for fault in faults)
        else "only pictures without light above the camera's noise and saturated ones"
    )
    return (
        f"{captures.folder} holds {what}: check that the laser was on and the exposure long enough, and that "
        f"camera.black_level = {captures.bench.camera.black_level:g} is right; then capture again"
    )
