"""The numbers of an estimate that a fit moves: their places in one vector, and what is likely of them beforehand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from runtime.calibration.drift import LASER_ORDERS, LOWEST_AMPLITUDE, LOWEST_WAVEFRONT, Drift
from runtime.calibration.estimate import Estimate
from runtime.calibration.misfit import Slopes
from runtime.camera.view import SENSITIVITY_ORDER, TERMS, View
from runtime.lightpath.legendre import legendre_count, legendre_moments

# Standard deviations of what is possible before any capture; they hold what no light shows.
LIKELY = {"wavefront": 1000.0, "amplitude": 1.0, "distance": 5.0, "view": 3.0}
LIKELY_LASER_NM = 300.0
LIKELY_STRETCH = 0.01  # of a homography from dots
SHARPEST = -0.05  # square pixels: a lens cannot sharpen; this much is room for noise
HELD = 1e30  # precision of what must not move
VIEW = (
    ("shift_y_px", 0.02),
    ("shift_x_px", 0.02),
    ("rotation_mrad", 0.05),
    ("distortion", 1e-3),
    ("blur_y_px2", 0.02),
    ("blur_x_px2", 0.02),
)  # fields of a View and the steps of their secants
STRETCH = tuple((name, 1e-3) for name in ("magnification", "aspect", "shear", "keystone_y", "keystone_x"))


class ParameterLayout:
    """Where each number of an estimate stands in the vector that is fitted.

    Parameters
    ----------
    channels : tuple of str
    wavefront, amplitude : int
        Highest Legendre orders of the wavefront and of the beam's amplitude; (0, 0) holds the distance too.
    view : tuple of (str, float)
        Fields of the view that are fitted, and the steps of their secants.

    Attributes
    ----------
    laser : int
        Numbers of a laser's own wavefront, where there are several; the first one's are held at 0.
    block : int
        Numbers of each colour: its amplitude's, then its laser's.
    edges : int array [5]
        Where wavefront, colours, distance and view begin in the vector, and its length.
    precision : float array [edges[-1]]
        1 / variance of each number beforehand.
    """

    def __init__(
        self,
        channels: tuple[str, ...],
        wavefront: int,
        amplitude: int,
        view: tuple[tuple[str, float], ...] = VIEW,
    ) -> None:
        self.channels, self.view = channels, view
        self.orders = (wavefront, amplitude)
        self.wavefront = legendre_count(wavefront, LOWEST_WAVEFRONT) if wavefront >= 2 else 0
        self.amplitude = legendre_count(amplitude, LOWEST_AMPLITUDE) if amplitude >= 1 else 0
        self.laser = legendre_count(*LASER_ORDERS) if self.wavefront and len(channels) > 1 else 0
        self.block = self.amplitude + self.laser
        sizes = [self.wavefront, self.block * len(channels), 1, len(view) + TERMS + 1]
        self.edges = np.cumsum([0, *sizes])
        spread = [np.full(n, LIKELY[k]) for n, k in zip(sizes, LIKELY, strict=True)]
        self.precision = 1 / np.concatenate(spread) ** 2
        for k in range(len(channels)):
            own = self.edges[1] + k * self.block + self.amplitude
            self.precision[own : own + self.laser] = 1 / LIKELY_LASER_NM**2 if k else HELD
        self.precision[self.edges[3] + len(VIEW) :][: len(view) - len(VIEW)] = 1 / LIKELY_STRETCH**2
        if not any(self.orders):
            self.precision[self.edges[2]] = HELD

    def places_of(self, other: ParameterLayout) -> np.ndarray:
        """Where the numbers of a layout of the same orders or lower stand in this one's vector."""
        begin, names = self.edges, [name for name, _ in self.view]
        beams = [
            begin[1]
            + k * self.block
            + np.r_[0 : other.amplitude, self.amplitude : self.amplitude + other.laser]
            for k in range(len(other.channels))
        ]
        view = [begin[3] + names.index(name) for name, _ in other.view]
        rest = begin[3] + len(names) + np.arange(TERMS + 1)
        return np.concatenate([np.arange(other.wavefront), *beams, [begin[2]], view, rest]).astype(int)

    def numbers(self, estimate: Estimate) -> np.ndarray:
        """The vector of an estimate."""
        drift, view = estimate.drift, estimate.view
        beams = [
            part
            for c in self.channels
            for part in (drift.log_amplitude[c], drift.laser_nm.get(c, np.zeros(self.laser)))
        ]
        of_view = [getattr(view, name) for name, _ in self.view]
        parts = [drift.wavefront_nm, *beams, [drift.distance_mm], of_view, view.sensitivity, [view.stray]]
        return np.concatenate([np.asarray(p, float) for p in parts])

    def moved(self, estimate: Estimate, step: np.ndarray) -> Estimate:
        """An estimate with a vector added to its numbers."""
        vector = self.numbers(estimate) + step
        wavefront, beams, distance, of_view = (
            vector[a:b] for a, b in zip(self.edges[:-1], self.edges[1:], strict=True)
        )
        split = beams.reshape(len(self.channels), self.block)
        drift = replace(
            estimate.drift,
            wavefront_nm=wavefront,
            log_amplitude=dict(zip(self.channels, split[:, : self.amplitude], strict=True)),
            laser_nm=dict(zip(self.channels, split[:, self.amplitude :], strict=True)),
            distance_mm=float(distance[0]),
        )
        values: dict[str, Any] = dict(zip((name for name, _ in self.view), map(float, of_view), strict=False))
        for name in ("blur_y_px2", "blur_x_px2"):
            values[name] = max(values[name], SHARPEST)
        sensitivity = tuple(float(v) for v in of_view[len(self.view) : -1])
        view = replace(estimate.view, sensitivity=sensitivity, stray=float(of_view[-1]), **values)
        return Estimate(drift, view)

    def gradient(
        self,
        slopes: Slopes,
        wavelengths_nm: Mapping[str, float],
        levers: Mapping[str, tuple[np.ndarray, np.ndarray]],
    ) -> np.ndarray:
        """The gradient of chi squared over the vector.

        Parameters
        ----------
        slopes : Slopes
        wavelengths_nm : mapping of str to float, nm
            Of each colour.
        levers : mapping of str to (float32 array [h, w], float32 array [h, w])
            As from `levers`.
        """
        wavefront, beams = np.zeros(self.wavefront), []
        for channel in self.channels:
            over, turn = slopes.over_panel[channel], 2 * math.pi / wavelengths_nm[channel]
            if self.wavefront:
                wavefront += turn * legendre_moments(over.imag, self.orders[0], LOWEST_WAVEFRONT)
            if self.amplitude:
                beams.append(legendre_moments(over.real, self.orders[1], LOWEST_AMPLITUDE))
            if self.laser:
                beams.append(turn * legendre_moments(over.imag, *LASER_ORDERS))
        blur = dict(zip(("blur_y_px2", "blur_x_px2"), map(float, slopes.blur), strict=True))
        of_view = [
            blur[name]
            if name in blur
            else float(np.vdot(slopes.over_y, levers[name][0]) + np.vdot(slopes.over_x, levers[name][1]))
            for name, _ in self.view
        ]
        sensitivity = legendre_moments(slopes.over_sensitivity, SENSITIVITY_ORDER)
        return np.concatenate([wavefront, *beams, [slopes.distance], of_view, sensitivity, [slopes.stray]])

    def levers(self, view: View, panel: tuple[int, int]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """How far each field that moves the view moves where its pixels look, (y, x): panel pixels a unit, [h, w]."""
        before, found = view.positions(panel), {}
        for name, step in self.view:
            if not name.startswith("blur"):
                after = replace(view, **{name: getattr(view, name) + step}).positions(panel)
                down, right = (
                    ((b - a) / step).astype(np.float32) for a, b in zip(before, after, strict=True)
                )
                found[name] = (down, right)
        return found

    def widened(self, estimate: Estimate) -> Estimate:
        """An estimate with as many terms as are to be fitted: further ones 0."""
        drift = estimate.drift
        beams = {c: _sized(drift.log_amplitude.get(c, np.zeros(0)), self.amplitude) for c in self.channels}
        lasers = {c: _sized(drift.laser_nm.get(c, np.zeros(0)), self.laser) for c in self.channels}
        wavefront = _sized(drift.wavefront_nm, self.wavefront)
        wider = replace(drift, wavefront_nm=wavefront, log_amplitude=beams, laser_nm=lasers)
        return replace(estimate, drift=wider)

    def nothing(self, estimate: Estimate) -> Estimate:
        """An estimate that says that nothing has drifted."""
        return self.widened(Estimate(Drift(), View(estimate.view.shape)))

    def prior(self, estimate: Estimate) -> float:
        """What an estimate adds to chi squared by being unlikely."""
        return float(np.sum(self.precision * self.numbers(estimate) ** 2))


def _sized(terms: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([terms, np.zeros(max(0, count - len(terms)))])[:count]
