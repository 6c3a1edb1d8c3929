"""Derivatives of a prediction over each number of an estimate: the columns of the fit's Jacobian, one at a time.

Those over wavefront, beam and distance are the light path's own linearisation, 2 Re(z* dz): one propagation each. Those
over the camera's view cost none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from runtime.calibration.drift import LASER_ORDERS, LOWEST_AMPLITUDE, LOWEST_WAVEFRONT, axial_phase
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot
from runtime.calibration.parameter_layout import ParameterLayout
from runtime.calibration.prediction import Predictor, enough_for_direction
from runtime.camera.view import SENSITIVITY_ORDER, TERMS
from runtime.lightpath.legendre import legendre_map_by_map
from runtime.solver.in_place_path import Optics


class Columns:
    """The columns at one estimate.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    estimate : Estimate
    layout : ParameterLayout

    Attributes
    ----------
    predictor : Predictor
        Of the estimate.
    """

    def __init__(
        self, bases: Mapping[str, ColourLightPath], estimate: Estimate, layout: ParameterLayout
    ) -> None:
        self.bases, self.estimate, self.layout = bases, estimate, layout
        self.predictor = Predictor(bases, enough_for_direction(bases))
        self.predictor.take(estimate)
        panel = next(iter(bases.values())).path.grid.shape
        self.levers = layout.levers(estimate.view, panel)
        self.moved: dict[str, Optics] = {}

    def of(self, shot: Shot) -> Iterator[tuple[int, np.ndarray]]:
        """Derivatives of a shot's prediction, float32 [h, w], with the place of each in the vector."""
        predictor, layout, channel = self.predictor, self.layout, shot.channel
        reading, phase = predictor.readings[channel], predictor.phase(shot)
        path, wavelength = predictor.paths[channel], self.bases[channel].wavelength_nm
        seen = reading.read(predictor.image(channel, phase))
        light, place = seen * predictor.even, int(layout.edges[3])
        down, right = reading.moved()
        blur = dict(zip(("blur_y_px2", "blur_x_px2"), reading.blurred(), strict=True))
        for k, (name, _) in enumerate(layout.view):
            if name in blur:
                yield place + k, blur[name] * predictor.even
            else:
                by_y, by_x = self.levers[name]
                yield place + k, (down * by_y + right * by_x) * predictor.even
        for k, one in enumerate(legendre_map_by_map(light.shape, SENSITIVITY_ORDER)):
            yield place + len(layout.view) + k, light * one
        yield place + len(layout.view) + TERMS, np.full(light.shape, seen.mean(), np.float32)

        if channel not in self.moved:
            self.moved.clear()  # a colour's buffers at a time
            self.moved[channel] = Optics(path, path.grid.fine, True, predictor.backend, apart=True)
        moved = self.moved[channel]
        moved.take(path)
        turned = moved.in_band_order(1j * axial_phase(path, wavelength)[None], path.grid)[0]
        moved.transfers = [t * turned.astype(t.dtype) for t in moved.transfers]
        yield int(layout.edges[2]), self._change(channel, phase)
        moved.take(path)
        turn = np.complex64(2j * math.pi / wavelength)
        if layout.wavefront:
            for k, one in enumerate(legendre_map_by_map(path.grid.shape, layout.orders[0], LOWEST_WAVEFRONT)):
                yield k, self._change(channel, phase, turn * one)
        place = int(layout.edges[1]) + layout.channels.index(channel) * layout.block
        if layout.laser:
            for k, one in enumerate(legendre_map_by_map(path.grid.shape, *LASER_ORDERS)):
                yield place + layout.amplitude + k, self._change(channel, phase, turn * one)
        if layout.amplitude:
            for k, one in enumerate(legendre_map_by_map(path.grid.shape, layout.orders[1], LOWEST_AMPLITUDE)):
                yield place + k, self._change(channel, phase, one)

    def _change(self, channel: str, phase: np.ndarray, factor: np.ndarray | None = None) -> np.ndarray:
        """2 Re(z* dz) summed over states and modes, as the camera sees it.

        dz is of what `moved` does to light, with a relative change [H, W] of the field that leaves the panel.
        """
        predictor, moved, path = self.predictor, self.moved[channel], self.predictor.paths[channel]
        if factor is not None:
            moved.panel.source = path.source * factor
            moved.panel.leak = None if path.leak is None else path.leak * factor
        image = predictor.images[path.grid]
        moved.irradiance(phase, image)
        still, plane = predictor.optics[channel].image_plane, moved.image_plane
        pairs = list(zip(still.weights, still.fields, plane.fields, strict=True))

        def work(worker: int, rows: slice) -> None:
            image[rows] = 0
            for weight, z, dz in pairs:
                both = np.conj(z[rows])
                both *= dz[rows]
                image[rows] += both.dtype.type(2 * weight).real * both.real

        predictor.backend.over_rows(len(image), plane.strip, work)
        seen = predictor.readings[channel].read(image)
        return seen * predictor.even + np.float32(self.estimate.view.stray * float(seen.mean()))
