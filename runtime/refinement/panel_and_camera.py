"""Panel and camera together, for captures of what is displayed; nothing here can set a laser's power."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from runtime.camera.view import View, on_panel
from runtime.headset.colour_fields import ColourPanel

Turn = Callable[[], None]


class PanelAndCamera:
    """Shows patterns, and returns the camera's pictures of them on the panel's pixels.

    Parameters
    ----------
    panel, camera
        Devices of a headset. A ColourPanel shows the patterns of all colours, each in its own field.
    view : View
        Where the camera sees the image plane, from a calibration.
    black : float
        Counts without light.
    turns : sequence of callable, or None
        For each of several colours, a function that makes it the only one that is lit, at its power and exposure. None:
        the only colour is lit already, and its light is not changed.
    settling : int
        Pictures of each pattern that are not used, because a slow panel still shows the pattern before.
    """

    def __init__(
        self,
        panel: Any,
        camera: Any,
        view: View,
        black: float,
        turns: Sequence[Turn] | None = None,
        settling: int = 0,
    ) -> None:
        self.panel, self.camera, self.view, self.black, self.turns = panel, camera, view, black, turns
        self.settling = settling

    def __call__(self, gray: np.ndarray) -> np.ndarray:
        """Show the colours of a pattern one after the other and capture each.

        Parameters
        ----------
        gray : uint8 array [C, H, W]

        Returns
        -------
        float32 array [C, H, W]
            Irradiance, of any scale for each colour.
        """
        captured = []
        for colour, field in enumerate(gray):
            if self.turns is not None:
                self.turns[colour]()
            if isinstance(self.panel, ColourPanel):
                self.panel.show_colours(gray)
            else:
                self.panel.show(field)
            for _ in range(self.settling):
                self.camera.capture()
            counts = np.asarray(self.camera.capture(), np.float32) - np.float32(self.black)
            captured.append(on_panel(counts, self.view, field.shape))
        return np.stack(captured)
