"""Exposures of the emulated OAK camera that stands in front of a simulated bench."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import CameraDescription
from firmware_iface.virtual.oak.oak_model import Expose

BITS = 10


def expose_bench(capture: Callable[[float], NDArray[np.uint16]], camera: CameraDescription) -> Expose:
    """The sensor of the emulated camera, at the place of the bench's camera.

    Parameters
    ----------
    capture : callable
        From an exposure in ms to a picture of the bench's camera, counts [h, w], at unit gain.
    camera : CameraDescription
        The bench's camera; its counts are converted to 10 bits, and gain acts above its black level.

    Returns
    -------
    callable
        From exposure in ms and gain to 10-bit counts, uint16 array [h, w].
    """
    to_ten_bits = 2.0 ** (BITS - camera.bit_depth)

    def expose(exposure_ms: float, gain: float) -> NDArray[np.uint16]:
        above_black = capture(exposure_ms).astype(np.float64) - camera.black_level
        counts = to_ten_bits * (camera.black_level + gain * above_black)
        return np.clip(np.rint(counts), 0, 2**BITS - 1).astype(np.uint16)

    return expose
