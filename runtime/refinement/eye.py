"""What looks at a display while it shows: panel and camera, and nothing that could move a laser."""

from __future__ import annotations

from typing import Any

import numpy as np

from runtime.calibration.view import View, on_panel


class Eye:
    """Shows patterns of the one colour that is lit, and returns what the camera sees on the panel's pixels.

    panel, camera: of a headset. view: how the camera sees the image plane, from a calibration. black: counts
    without light. It is given no laser: light stays as whoever displays has set it.
    """

    def __init__(self, panel: Any, camera: Any, view: View, black: float) -> None:
        self.panel, self.camera, self.view, self.black = panel, camera, view, black

    def __call__(self, gray: np.ndarray) -> np.ndarray:
        """Irradiance of any scale, float32 [1, H, W], of gray levels [1, H, W]."""
        self.panel.show(gray[0])
        counts = np.asarray(self.camera.capture(), np.float32) - np.float32(self.black)
        return on_panel(counts, self.view, gray.shape[1:])[None]
