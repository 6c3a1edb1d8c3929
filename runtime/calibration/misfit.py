"""How badly an estimate explains captures, and which way it gets better: chi squared and its slopes.

The slopes over all that a fit moves come from one pass forward and one back a capture, by the adjoint of the light
path and of the camera. They are kept as maps: over the field on the panel, from which the slopes over polynomials and
over splines follow alike, and over where each pixel of the camera looks, from which those over its motion follow. So
time and memory grow with the number of pixels alone. One capture at a time is worked on, in buffers used again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.calibration.drift import axial_phase
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, gain_of, with_stray
from runtime.calibration.prediction import Predictor


@dataclass(frozen=True)
class Slopes:
    """The gradient of chi squared.

    Attributes
    ----------
    over_panel : mapping of str to complex array [H, W]
        Of each colour, over a factor on the field that leaves the panel: the real part over its logarithm, the
        imaginary part over its phase (rad).
    distance : float, 1 / mm
    over_y, over_x : float32 array [h, w], 1 / panel pixel
        Over where each pixel of the camera looks.
    over_sensitivity : float32 array [h, w]
        Over the logarithm of each pixel's sensitivity.
    blur : float array [2], 1 / panel pixel squared
        Over the variances of the lens's blur, along y and x.
    stray : float
    """

    over_panel: Mapping[str, np.ndarray]
    distance: float
    over_y: np.ndarray
    over_x: np.ndarray
    over_sensitivity: np.ndarray
    blur: np.ndarray
    stray: float


class Misfit:
    """Chi squared of captures, each with its own best gain.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    shots : sequence of Shot
    finer : int
        Of the camera's `sampler`.
    motion : bool
        Whether slopes over the camera's motion are wanted; without, those maps are 0.
    light : bool
        Whether slopes over the light path are wanted; without, those are 0, the light path stays that of the first
        estimate, and each shot's irradiance is computed once.
    """

    def __init__(
        self,
        bases: Mapping[str, ColourLightPath],
        shots: Sequence[Shot],
        finer: int = 2,
        motion: bool = True,
        light: bool = True,
    ) -> None:
        self.shots, self.motion, self.light = shots, motion, light
        self.images: list[np.ndarray] = []  # of each shot, where the light path stays
        self.predictor = Predictor(bases, finer, motion)
        self.axial: dict[str, np.ndarray] = {}
        for name, base in (bases if light else {}).items():
            phase = axial_phase(base.path, base.wavelength_nm)[None]
            ordered = self.predictor.optics[name].in_band_order(phase, base.path.grid)
            self.axial[name] = ordered[0].astype(np.float32)

    def at(self, estimate: Estimate) -> tuple[float, Slopes]:
        """Chi squared of an estimate, and its slopes."""
        predictor, view = self.predictor, estimate.view
        if self.light:
            predictor.take(estimate)
        else:
            self._stay(estimate)
        over_panel = {c: np.zeros(p.grid.shape, np.complex64) for c, p in predictor.paths.items()}
        maps = np.zeros((3, *view.shape), np.float32)
        blur, total, distance, stray = np.zeros(2), 0.0, 0.0, 0.0
        for number, shot in enumerate(self.shots):
            channel = shot.channel
            reading = predictor.readings[channel]
            phase = predictor.phase(shot) if self.light else None
            image = self.images[number] if phase is None else predictor.image(channel, phase)
            seen = reading.read(image)
            light = with_stray(view, predictor.even, seen)
            gain = gain_of(shot, light)
            residual = shot.signal - np.float32(gain) * light
            slope = shot.weight * residual
            total += float(np.vdot(slope, residual))
            slope *= np.float32(-2 * gain)
            stray += float(seen.mean()) * float(slope.sum(dtype=np.float64))
            mean = np.float32(view.stray * float(slope.mean(dtype=np.float64)))
            slope *= predictor.even
            maps[2] += slope * seen
            if self.motion:
                for one, moved in zip(maps, reading.motion(), strict=False):
                    moved *= slope
                    one += moved
            slope += mean
            back, of_blur = reading.adjoint(slope)
            blur += of_blur
            if phase is not None:
                optics = predictor.optics[channel]
                distance += optics.factor_adjoint(phase, back, over_panel[channel], self.axial[channel])
        return total, Slopes(over_panel, distance, maps[0], maps[1], maps[2], blur, stray)

    def _stay(self, estimate: Estimate) -> None:
        """Keep the light path, and take an estimate's view alone."""
        if self.images:
            self.predictor.look(estimate.view)
            return
        self.predictor.take(estimate)
        for shot in self.shots:
            self.images.append(self.predictor.image(shot.channel, self.predictor.phase(shot)).copy())
        self.predictor.forget_light()
