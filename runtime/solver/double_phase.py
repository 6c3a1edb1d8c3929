"""Double phase, a pattern that shows a picture without iterations, and flat phase: where a solve begins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.lightpath.light_path import LightPath
from runtime.solver.angles import angle_into, arccos_into
from runtime.solver.in_place_path import Optics
from runtime.solver.objective import Objective

Array = Any

BOARDS = 8  # ways for the pixels of double phase to alternate
LOUD = 0.98  # share of pixels whose amplitude double phase reproduces; brighter ones are cut
SAMPLED = 5  # every so many pixels, an axis, are ranked for that
FAINTEST = 0.7  # of the amplitude in the middle: fainter edges of the image are corrected only as far as this
EDGES = 3  # times as far in as the panel's end darkens an even image, edges of a frame get a new start
WIDE = 0.9  # of the panel's band: with a wider iris double phase errs by more than its edges


class Start:
    """First phases for one colour of an objective, in place.

    Parameters
    ----------
    objective : Objective
    path : LightPath
        Of the colour's first plane.
    colour : int
    doubled : bool
        Whether the start is double phase.

    Attributes
    ----------
    ramp : list of complex array [H], [W]
        Tilt of the light in the image, for a pupil whose opening is off the axis, to the middle of what it passes.
    lift : float array [H, W] or None
        What an amplitude is multiplied by: the panel ends, so the edges of an image get only part of their light.
        None where the start is not double phase, and where the iris is open (WIDE).
    edges : (int, int), pixels
        How far in that goes: rows, columns.
    """

    def __init__(self, objective: Objective, path: LightPath, colour: int, doubled: bool) -> None:
        xp = objective.backend.xp
        self.backend, self.objective, self.colour = objective.backend, objective, colour
        self.optics: Optics = objective.optics[colour * objective.frames][0]
        height, width = path.grid.shape
        pair = path.source.dtype
        self.wave = xp.zeros((height, width), pair)
        strip = (3, objective.strip, width)
        self.rooms = [xp.empty(strip, path.response.dtype) for _ in range(self.backend.threads)]
        tiny = 1e-3 * math.sqrt(objective.power[colour]) + 1e-30
        self.over_source: Array = None
        if self.optics.panel.source is not None or path.leak is not None:
            self.over_source = xp.asarray(
                (np.conj(path.source) / np.maximum(np.abs(path.source), tiny) ** 2).astype(pair)
            )
        leak = self.optics.panel.leak
        self.unmodulated = None if leak is None else leak * self.over_source
        self.ramp = [
            _turns(cycles, n, pair) for cycles, n in zip(middle_of(path), (height, width), strict=True)
        ]
        self.lift: Array = None
        self.edges = 0, 0
        if doubled and path.grid.band_share < WIDE:
            self._find_edges()

    def double_phase(self, amplitude: np.ndarray, phase: Array, others: Sequence[Array] = ()) -> None:
        """Fill `phase` (rad) [H, W] with a pattern that shows an amplitude [H, W] at once, without iterations.

        The amplitude with flat phase goes back to the panel; there a pixel's complex amplitude a exp(j t),
        a <= 1, is the mean of exp(j (t + acos a)) and exp(j (t - acos a)), which alternate as on a chequerboard.

        Up to BOARDS - 1 `others` get patterns that show it as well and differ: their pixels alternate otherwise.

        References
        ----------
        Hsueh and Sawchuk 1978; Maimone et al. 2017.
        """
        self._wave(amplitude)
        xp, wave = self.backend.xp, self.wave
        some = xp.abs(wave[::SAMPLED, ::SAMPLED]).ravel()
        rank = min(some.size - 1, int(LOUD * some.size))
        loud = 1 / max(float(xp.partition(some, rank)[rank]), 1e-30)
        unmodulated = self.unmodulated

        def work(worker: int, rows: slice) -> None:
            count = rows.stop - rows.start
            part, new, here = self.objective.part[worker][:count], phase[rows], wave[rows]
            half, one, two = (room[:count] for room in self.rooms[worker])
            here *= loud
            if unmodulated is not None:
                here -= unmodulated[rows]
            xp.abs(here, out=part)
            xp.minimum(part, 1, out=part)
            arccos_into(xp, part, half, one)
            odd = rows.start % 2
            half[odd::2, 1::2] *= -1
            half[1 - odd :: 2, ::2] *= -1
            angle_into(xp, here.imag, here.real, new, (one, two, part))
            for number, other in enumerate(others, 1):
                other[rows] = new + self._alternating(number, rows) * half
            new += half

        self.backend.over_rows(len(phase), self.objective.strip, work)

    def _alternating(self, number: int, rows: slice) -> Array:
        """Signs of a pattern's pixels in these rows, over those of the first pattern's chequerboard."""
        xp, width = self.backend.xp, self.wave.shape[1]
        y, x = xp.arange(rows.start, rows.stop)[:, None], xp.arange(width)
        board = y + x
        along = (board, y + 0 * x, x + 0 * y, y // 2 + x)[number // 2]
        return (1 - 2 * ((board + along + number) % 2)).astype(np.int8)

    def flat_phase(self, amplitude: np.ndarray, phase: Array) -> None:
        """Fill `phase` with that of the amplitude with flat phase, back at the panel; its amplitude there is lost.

        A better start than double phase where the panel does not reach a whole turn.
        """
        self._wave(amplitude)
        xp, wave = self.backend.xp, self.wave

        def work(worker: int, rows: slice) -> None:
            rooms = [room[: rows.stop - rows.start] for room in self.rooms[worker]]
            angle_into(xp, wave[rows].imag, wave[rows].real, phase[rows], rooms)

        self.backend.over_rows(len(phase), self.objective.strip, work)

    def _find_edges(self) -> None:
        """Find `lift` and `edges` from an even image that goes back to the panel and forward again.

        The field that goes forward is complex: the mean of the fields of the two phases that double phase is made of.
        """
        xp, optics, wave = self.backend.xp, self.optics, self.wave
        self._wave(np.ones(wave.shape, np.float32))
        size, angle = xp.abs(wave), xp.arctan2(wave.imag, wave.real)
        size /= size.max()
        xp.arccos(size, out=size)
        light, mode = xp.zeros(wave.shape, angle.dtype), optics.strongest
        optics.forward(angle + size, light)
        wave[...] = optics.image_plane.fields[mode][optics.at_pixels]
        optics.forward(angle - size, light)
        wave += optics.image_plane.fields[mode][optics.at_pixels]
        reached = xp.abs(wave)
        reached /= max(float(xp.median(reached[::SAMPLED, ::SAMPLED])), 1e-30)
        down, across = (n // 2 for n in wave.shape)
        whole = (int(xp.argmax(along >= 1)) for along in (reached[:, across], reached[down]))
        self.edges = tuple(min(EDGES * n, middle) for n, middle in zip(whole, (down, across), strict=True))
        xp.clip(reached, FAINTEST, 1 / FAINTEST, out=reached)
        self.lift = 1 / reached

    def _wave(self, amplitude: np.ndarray) -> None:
        """Fill `wave` with the factor on the beam that each pixel would need, of any scale."""
        xp, wave, over = self.backend.xp, self.wave, self.over_source
        given, lift = xp.asarray(amplitude), self.lift

        def tilt(worker: int, rows: slice) -> None:
            xp.multiply(given[rows], self.ramp[0][rows, None], out=wave[rows])
            wave[rows] *= self.ramp[1]
            if lift is not None:
                wave[rows] *= lift[rows]

        def unlit(worker: int, rows: slice) -> None:
            wave[rows] *= over[rows]

        self.backend.over_rows(len(wave), self.objective.strip, tilt)
        self.optics.wave_at_panel(wave)
        if over is not None:
            self.backend.over_rows(len(wave), self.objective.strip, unlit)


def middle_of(path: LightPath) -> tuple[float, float]:
    """Middle of the frequencies that the strongest mode's pupil passes, cycles a pixel (rows, columns)."""
    passed = np.abs(path.transfers[int(np.argmax(path.weights))]) ** 2
    total = max(float(passed.sum()), 1e-30)
    middle = []
    for axis in (0, 1):
        cycles = np.asarray(path.grid.frequency_index(axis)) / path.grid.padded[axis]
        mean = float(passed.sum(1 - axis) @ cycles) / total
        # What a symmetric opening loses to aberrations or rounding is no reason for a ramp.
        middle.append(mean if abs(mean) > 0.02 * float(cycles[-1]) else 0.0)
    return middle[0], middle[1]


def _turns(cycles: float, count: int, pair: Any) -> np.ndarray:
    """exp(2 pi i cycles n) at `count` pixels."""
    return np.exp(2j * math.pi * cycles * np.arange(count)).astype(pair)
