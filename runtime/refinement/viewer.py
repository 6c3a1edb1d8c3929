"""What looks at a display while it shows: panel and camera, and nothing that could set a laser's power."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from runtime.camera.view import View, on_panel

Turn = Callable[[], None]


class Eye:
    """Shows patterns, and returns what the camera sees on the panel's pixels.

    panel, camera: of a headset. view: how the camera sees the image plane, from a calibration. black: counts
    without light. turns: for each of several colours, what makes it the one that is lit, at the power and exposure that
    whoever displays has chosen; none: the one colour is lit already, and light stays as it is.
    """

    def __init__(
        self, panel: Any, camera: Any, view: View, black: float, turns: Sequence[Turn] | None = None
    ) -> None:
        self.panel, self.camera, self.view, self.black, self.turns = panel, camera, view, black, turns

    def __call__(self, gray: np.ndarray) -> np.ndarray:
        """Irradiance of any scale a colour, float32 [C, H, W], of gray levels [C, H, W], one after the other."""
        seen = []
        for colour, field in enumerate(gray):
            if self.turns is not None:
                self.turns[colour]()
            self.panel.show(field)
            counts = np.asarray(self.camera.capture(), np.float32) - np.float32(self.black)
            seen.append(on_panel(counts, self.view, field.shape))
        return np.stack(seen)
