"""A simulated bench in front of the emulated camera."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import CameraDescription
from firmware_iface.virtual.oak.oak_model import Expose

BITS = 10


def expose_bench(capture: Callable[[float], NDArray[np.uint16]], camera: CameraDescription) -> Expose:
    """What the emulated sensor reads where the bench's camera stands.

    Parameters
    ----------
    capture : callable
        A picture of the bench's camera, counts [h, w], at unit gain and the exposure given in ms.
    camera : CameraDescription
        That camera; its counts are brought to 10 bits, and gain acts above its black level.

    Returns
    -------
    callable
    """
    to_ten_bits = 2.0 ** (BITS - camera.bit_depth)

    def expose(exposure_ms: float, gain: float) -> NDArray[np.uint16]:
        above_black = capture(exposure_ms).astype(np.float64) - camera.black_level
        counts = to_ten_bits * (camera.black_level + gain * above_black)
        return np.clip(np.rint(counts), 0, 2**BITS - 1).astype(np.uint16)

    return expose
