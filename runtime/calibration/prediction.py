"""What an estimate predicts of captures, in place: `runtime.calibration.estimate.predicted` for work that repeats it.

The light path is the solver's own, forward and adjoint, in buffers that are used for one capture after another. At
1080 x 1920 new arrays for each would cost more than the arithmetic on them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from runtime.calibration.drift import drifted
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, with_stray
from runtime.camera.reading import Reading
from runtime.camera.view import View
from runtime.lightpath import fft
from runtime.lightpath.grid import Grid
from runtime.lightpath.light_path import LightPath, panel_phase
from runtime.solver.array_backend import Backend, Room
from runtime.solver.in_place_path import Optics

SMALL = 200_000  # panel pixels up to which threads wait for each other longer than they work


def enough_for_direction(bases: Mapping[str, ColourLightPath]) -> int:
    """`finer` of a predictor that gives the direction of a step: the camera reads two samples a panel pixel."""
    return max(1, *(2 // b.path.grid.fine for b in bases.values()))


class Predictor:
    """Predicts captures of several colours.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    finer : int
        Of the camera's `sampler`.
    slopes : bool
        Whether the readings' `motion` is wanted.

    Attributes
    ----------
    estimate : Estimate
        What was last taken.
    paths, optics, readings : mappings of str
        Of each colour: the light path with the estimate's drift, the same in place, and its camera.
    even : float32 array [h, w]
        The view's evenness.
    """

    def __init__(self, bases: Mapping[str, ColourLightPath], finer: int = 2, slopes: bool = False) -> None:
        self.bases, self.finer, self.slopes = bases, finer, slopes
        size = max(b.path.grid.shape[0] * b.path.grid.shape[1] for b in bases.values())
        self.backend = Backend(fft.THREADS if size > SMALL else 1)
        room = Room(self.backend)
        self.optics = {
            c: Optics(b.path, b.path.grid.fine, True, self.backend, room, apart=True)
            for c, b in bases.items()
        }
        self.paths: dict[str, LightPath] = {}
        self.readings: dict[str, Reading] = {}
        self.images: dict[Grid, np.ndarray] = {}
        self.view: View | None = None
        self.even = np.ones((1, 1), np.float32)

    def take(self, estimate: Estimate) -> None:
        """Predict by another estimate from now on."""
        for name, base in self.bases.items():
            path = drifted(base.path, name, base.wavelength_nm, estimate.drift)
            self.optics[name].take(path)
            self.paths[name] = path
        self.look(estimate.view)

    def look(self, view: View) -> None:
        """Predict by another view of the camera from now on, and the same light."""
        if view == self.view:
            return
        self.view, self.even = view, view.evenness().astype(np.float32)
        self.readings = {}  # first let the old ones' memory go
        made: dict[object, Reading] = {}
        for name, path in self.paths.items():
            # Colours differ in their room for light to spread, which no camera sees.
            seen = (path.grid.shape, path.grid.margin, path.grid.pitch, path.grid.fine)
            key = (seen, None if path.irradiance_filter is None else name)
            if key not in made:
                made[key] = Reading(
                    self.view,
                    path.grid,
                    path.irradiance_filter,
                    self.finer,
                    self.slopes,
                    self.backend.threads,
                )
            self.readings[name] = made[key]

    def forget_light(self) -> None:
        """Let the light paths' buffers go, half a gigabyte at full size: from now on only the camera is asked."""
        self.optics.clear()
        self.images.clear()

    def phase(self, shot: Shot, response: np.ndarray | None = None) -> np.ndarray:
        """Phase (rad) that a shot's pattern drives the panel to, [H, W]; `response` in place of the estimate's."""
        path = self.paths[shot.channel]
        if response is not None:
            path = replace(path, response=np.asarray(response, path.response.dtype))
        return np.asarray(panel_phase(path, shot.gray))

    def image(self, channel: str, phase: np.ndarray) -> np.ndarray:
        """Irradiance on the fine grid before filters; the fields are in `optics`. Valid until the next call."""
        grid = self.paths[channel].grid
        if grid not in self.images:
            self.images[grid] = np.zeros(grid.image_shape, np.float32)
        self.optics[channel].irradiance(phase, self.images[grid])
        return self.images[grid]

    def light(self, shot: Shot, response: np.ndarray | None = None) -> np.ndarray:
        """What the camera sees of a shot's pattern, as `predicted`: float32 [h, w]."""
        assert self.view is not None
        image = self.image(shot.channel, self.phase(shot, response))
        return with_stray(self.view, self.even, self.readings[shot.channel].read(image))
