"""How badly an estimate explains captures, and which way it gets better: chi squared and its slopes.

The slopes over all that a fit moves come from one pass forward and one back a capture, by the adjoint of the light
path and of the camera. They are kept as maps: over the field on the panel, from which the slopes over polynomials and
over splines follow alike, and over where each pixel of the camera looks, from which those over its motion follow. So
time and memory grow with the number of pixels alone. One capture at a time is worked on, in buffers that are used again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.calibration.drift import axial_phase, drifted
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, gain_of, with_stray
from runtime.camera.reading import Reading
from runtime.camera.view import View
from runtime.lightpath.grid import FINE, Grid
from runtime.lightpath.light_path import LightPath, panel_phase
from runtime.solver.array_backend import Backend
from runtime.solver.in_place_path import Optics


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
    """

    def __init__(
        self,
        bases: Mapping[str, ColourLightPath],
        shots: Sequence[Shot],
        finer: int = 2,
        motion: bool = True,
    ) -> None:
        self.bases, self.shots, self.finer, self.motion = bases, shots, finer, motion
        self.optics: dict[str, Optics] = {}
        self.axial: dict[str, np.ndarray] = {}
        self.images: dict[Grid, np.ndarray] = {}
        self.readings: dict[str, Reading] = {}
        self.view: View | None = None
        for name, base in bases.items():
            optics = Optics(base.path, FINE, True, Backend())
            phase = axial_phase(base.path, base.wavelength_nm)[None]
            self.axial[name] = optics.in_band_order(phase, base.path.grid)[0].astype(np.float32)
            self.optics[name] = optics

    def at(self, estimate: Estimate) -> tuple[float, Slopes]:
        """Chi squared of an estimate, and its slopes."""
        view = estimate.view
        even = view.evenness().astype(np.float32)
        paths = self._prepared(estimate)
        over_panel = {
            c: np.zeros(b.path.grid.shape, np.complex64) for c, b in self.bases.items()
        }
        maps = np.zeros((3, *view.shape), np.float32)
        blur, total, distance, stray = np.zeros(2), 0.0, 0.0, 0.0
        for shot in self.shots:
            path, optics, reading = paths[shot.channel], self.optics[shot.channel], self.readings[shot.channel]
            phase = panel_phase(path, shot.gray)
            image = self._image(path.grid)
            optics.irradiance(phase, image)
            seen = reading.read(image)
            light = with_stray(view, even, seen)
            gain = gain_of(shot, light)
            residual = shot.signal - np.float32(gain) * light
            slope = shot.weight * residual
            total += float(np.vdot(slope, residual))
            slope *= np.float32(-2 * gain)
            stray += float(seen.mean()) * float(slope.sum(dtype=np.float64))
            mean = np.float32(view.stray * float(slope.mean(dtype=np.float64)))
            slope *= even
            maps[2] += slope * seen
            if self.motion:
                for one, motion in zip(maps, reading.motion(), strict=False):
                    motion *= slope
                    one += motion
            slope += mean
            back, of_blur = reading.adjoint(slope)
            blur += of_blur
            distance += optics.factor_adjoint(phase, back, over_panel[shot.channel], self.axial[shot.channel])
        return total, Slopes(over_panel, distance, maps[0], maps[1], maps[2], blur, stray)

    def _prepared(self, estimate: Estimate) -> dict[str, LightPath]:
        """The light paths of an estimate, which the optics go on with, and readings of its view."""
        paths = {c: drifted(b.path, c, b.wavelength_nm, estimate.drift) for c, b in self.bases.items()}
        for name, path in paths.items():
            self.optics[name].take(path)
        if estimate.view != self.view:
            self.view, made = estimate.view, {}
            self.readings = {}  # the old ones' memory first
            for name, path in paths.items():
                key = (path.grid, None if path.irradiance_filter is None else name)
                if key not in made:
                    made[key] = Reading(
                        estimate.view, path.grid, path.irradiance_filter, self.finer, self.motion
                    )
                self.readings[name] = made[key]
        return paths

    def _image(self, grid: Grid) -> np.ndarray:
        """Room for irradiance on a fine grid."""
        if grid not in self.images:
            self.images[grid] = np.zeros(grid.image_shape, np.float32)
        return self.images[grid]
