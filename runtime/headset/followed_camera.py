"""A camera with something that is done after each of its pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class FollowedCamera:
    """A camera, and what is done with each picture before whoever asked for it gets it.

    Parameters
    ----------
    camera : Camera
        All else is as it does it.
    follow : callable
        Called with each picture. What it raises, `capture` raises in place of the picture.
    """

    __slots__ = ("_camera", "_follow")

    def __init__(self, camera: Any, follow: Callable[[np.ndarray], None]) -> None:
        self._camera, self._follow = camera, follow

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    @property
    def exposure_ms(self) -> float:
        """Exposure time, ms."""
        return float(self._camera.exposure_ms)

    @exposure_ms.setter
    def exposure_ms(self, value: float) -> None:
        self._camera.exposure_ms = value

    def capture(self) -> np.ndarray:
        """One picture, uint16 counts [h, w]."""
        counts = np.asarray(self._camera.capture())
        self._follow(counts)
        return counts
