"""How the camera moves against the picture: from capture to capture, and to and fro during an exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.further_defects import FrameMotion, Vibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraMotion:
    """Motion of one capture, panel pixels.

    Attributes
    ----------
    shift_y_px, shift_x_px : float, panel pixels
        The camera pixel that saw panel row i sees row i + shift_y_px.
    swing_y_px, swing_x_px : float, panel pixels
        Amplitude of the sinusoid in time.
    """

    shift_y_px: float = 0.0
    shift_x_px: float = 0.0
    swing_y_px: float = 0.0
    swing_x_px: float = 0.0

    def filter(self, fy: Array, fx: Array) -> NDArray[np.complex64]:
        """Effect on the irradiance's spectrum; f in cycles a pixel."""
        out: NDArray[np.complexfloating] = np.exp(2j * np.pi * (fy * self.shift_y_px + fx * self.shift_x_px))
        if self.swing_y_px or self.swing_x_px:
            turn = 2 * np.pi * (fy * self.swing_y_px + fx * self.swing_x_px)
            # Gauss-Chebyshev: the mean over equidistant moments is the mean over time, with enough of them
            moments = 8 + int(np.ceil(np.abs(turn).max()))
            places = np.cos(np.pi * (np.arange(moments) + 0.5) / moments)
            out = out * (sum(np.cos(turn * p) for p in places) / moments)
        return out.astype(np.complex64)


def camera_motion(bench: BenchDescription, seed: int, capture: int | None) -> CameraMotion | None:
    """The motion of a capture, by its number; None where the camera stands still.

    Parameters
    ----------
    bench : BenchDescription
    seed : int
        The headset's.
    capture : int or None
        None: where the camera stands in the mean, with the mean swing.
    """
    frame, vibration = bench.defect(FrameMotion), bench.defect(Vibration)
    shift, swing = np.zeros(2), np.zeros(2)
    if frame and capture is not None:
        shift = frame.rms_px * np.random.default_rng([seed, frame.seed, 67, capture]).standard_normal(2)
    if vibration:
        turn = np.deg2rad(vibration.direction_deg)
        swing = np.sqrt(2) * vibration.rms_px * np.array([np.sin(turn), np.cos(turn)])
        if capture is not None:
            more = np.random.default_rng([seed, 71, capture]).standard_normal()
            swing = swing * max(0.0, 1 + vibration.spread * float(more))
    if not shift.any() and not swing.any():
        return None
    return CameraMotion(*map(float, (*shift, *swing)))
