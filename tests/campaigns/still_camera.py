"""A camera that always gives the same picture: `kind = "tests.campaigns.still_camera:still_camera"`.

For headsets so large that a simulated picture would take longer than a frame.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

SHAPE = (240, 320)


class StillCamera:
    """As fast as its exposure."""

    shape, bit_depth, exposure_ms = SHAPE, 12, 10.0

    def __init__(self) -> None:
        self._counts = np.full(SHAPE, 64, np.uint16)

    def capture(self) -> np.ndarray:
        """The picture, uint16 counts [h, w]."""
        time.sleep(1e-3 * self.exposure_ms)
        return self._counts

    def status(self) -> dict[str, Any]:
        """Its exposure."""
        return {"exposure_ms": self.exposure_ms}

    def close(self) -> None:
        """There is nothing to release."""


def still_camera() -> StillCamera:
    """The camera."""
    return StillCamera()
