"""Double phase, a pattern that shows a picture without iterations, and flat phase: where a solve begins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
LIT = 0.1  # of the amplitude of the brightest pixels
EDGES = 3  # times as far in as the panel's end darkens an even image, edges of a frame get a new start
TILT = 0.4  # of the way from the middle of the pupil's opening to its edge; less where that is beyond half of the band
RISE = 8  # times as far as tilted light comes from the side: over this the tilt rises along an edge
RISE_MOST = 0.3  # of the panel: at large distances the tilt rises over this
RISE_LEAST = 3  # as RISE, of a still picture: a tilt that rises over less crowds the light, and there is none
WIDE = 0.9  # of the panel's band: with a wider iris double phase errs by more than its edges


@dataclass(frozen=True, eq=False)
class Tilt:
    """How the light in an image is tilted, and what the panel's end does to it.

    Attributes
    ----------
    turned : list of float array [H], [W], rad
        Phase of the light in the image, of rows and of columns (see `tilted`); in the host's memory.
    ramp : list of complex array [H], [W]
        The same, as factors; where the solver computes.
    rising : (slice, slice)
        Rows and columns over which the tilt rises.
    lift : float array [H, W] or None
        What an amplitude is multiplied by: the panel ends, so the edges of an image get only part of their light.
        None where the start is not double phase, and where the iris is open (WIDE).
    edges : (int, int), pixels
        How far in that goes: rows, columns.
    """

    turned: list[np.ndarray]
    ramp: list[Array]
    rising: tuple[slice, slice]
    lift: Array = None
    edges: tuple[int, int] = (0, 0)


class Start:
    """First phases for one colour of an objective, in place.

    Parameters
    ----------
    objective : Objective
    path : LightPath
        Of the colour's first plane.
    colour : int
    begins : bool
        Whether a solve begins with this start, and not with a network's.
    gapless : bool
        Whether the panel reaches a whole turn.
    planes : int
        Of the colour: a tilted image moves from plane to plane, so it is tilted where there is one.

    Attributes
    ----------
    doubled : bool
        Whether the start is double phase.
    still, moving : Tilt
        The light in the image of a still picture and of one that moves; the same one where there is no difference.
    light : Tilt
        Which of them starts have now.
    lit : bool array [H, W]
        Where the last double phase has so much amplitude that its phase means something.
    """

    def __init__(
        self,
        objective: Objective,
        path: LightPath,
        colour: int,
        begins: bool,
        gapless: bool,
        planes: int = 1,
    ) -> None:
        xp = objective.backend.xp
        self.backend, self.objective, self.colour = objective.backend, objective, colour
        self.optics: Optics = objective.optics[colour * objective.frames][0]
        height, width = path.grid.shape
        pair = path.source.dtype
        self.wave = xp.zeros((height, width), pair)
        self.loud = xp.ones((), path.response.dtype)  # factor on the wave that makes its brightest pixels 1
        self.lit = xp.ones((height, width), bool)
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
        # An open iris passes the chequerboard: what a gap in the turn takes of it, the descent does not mend there.
        stopped = path.grid.band_share < WIDE
        self.doubled = begins and (gapless or stopped)
        half_open = self.doubled and stopped
        tilts = [
            tilted(path, least) if half_open and planes == 1 else middle(path) for least in (RISE_LEAST, RISE)
        ]
        self.still = self.moving = self._tilt(tilts[0], half_open)
        if not all(map(np.array_equal, *tilts)):
            self.moving = self._tilt(tilts[1], half_open)
        self.light = self.still
        self._fill_wave = self.backend.recorded(self._wave)
        self._split = self.backend.recorded(self._split_now)

    def tilt(self, moves: bool) -> None:
        """Take the tilt for a still picture or for one that moves.

        Where a tilt rises fast, a still picture gains most, and the frames of a video are farther from it.
        """
        self.light = self.moving if moves else self.still

    def double_phase(
        self,
        amplitude: Array,
        phase: Array,
        others: Sequence[Array] = (),
        moved: tuple[int, int] = (0, 0),
    ) -> None:
        """Fill `phase` (rad) [H, W] with a pattern that shows an amplitude [H, W] at once, without iterations.

        The amplitude with flat phase goes back to the panel; there a pixel's complex amplitude a exp(j t),
        a <= 1, is the mean of exp(j (t + acos a)) and exp(j (t - acos a)), which alternate as on a chequerboard.

        Up to BOARDS - 1 `others` get patterns that show it as well and differ: their pixels alternate otherwise.

        The chequerboard is `moved` by (down, right) pixels, except along the panel's edges.

        References
        ----------
        Hsueh and Sawchuk 1978; Maimone et al. 2017.
        """
        self._fill_wave(amplitude, self.light)
        xp = self.backend.xp
        some = xp.abs(self.wave[::SAMPLED, ::SAMPLED]).ravel()
        rank = min(some.size - 1, int(LOUD * some.size))
        self.loud[...] = 1 / xp.maximum(xp.partition(some, rank)[rank], 1e-30)
        if others:
            self._split_now(phase, self.light, sum(moved) % 2, others, moved)
        else:
            self._split(phase, self.light, sum(moved) % 2)

    def _split_now(
        self,
        phase: Array,
        light: Tilt,
        odd: int,
        others: Sequence[Array] = (),
        moved: tuple[int, int] = (0, 0),
    ) -> None:
        """Fill `phase`, and `others`, from the wave, which is used up; `odd`: the chequerboard is the other one."""
        xp, wave, unmodulated = self.backend.xp, self.wave, self.unmodulated

        def work(worker: int, rows: slice) -> None:
            count = rows.stop - rows.start
            part, new, here = self.objective.part[worker][:count], phase[rows], wave[rows]
            half, one, two = (room[:count] for room in self.rooms[worker])
            here *= self.loud
            if unmodulated is not None:
                here -= unmodulated[rows]
            xp.abs(here, out=part)
            xp.greater_equal(part, LIT, out=self.lit[rows])
            xp.minimum(part, 1, out=part)
            arccos_into(xp, part, half, one)
            shifted = rows.start % 2
            half[shifted::2, 1::2] *= -1
            half[1 - shifted :: 2, ::2] *= -1
            if odd:
                half[self._inside(rows, light)] *= -1
            angle_into(xp, here.imag, here.real, new, (one, two, part))
            for number, other in enumerate(others, 1):
                other[rows] = new + self._alternating(number, rows, moved) * half
            new += half

        self.backend.over_rows(len(phase), self.objective.strip, work)

    def retilt(self, motion: tuple[int, int], phase: Array) -> None:
        """Give a pattern's phase (rad) [H, W] that has been moved (down, right) the tilt of its new place."""
        down, right = (
            self.backend.xp.asarray((turned - np.roll(turned, step)).astype(phase.dtype))
            for turned, step in zip(self.light.turned, motion, strict=True)
        )
        phase += down[:, None]
        phase += right

    def _alternating(self, number: int, rows: slice, moved: tuple[int, int]) -> Array:
        """Signs of a pattern's pixels in these rows, over those of the first pattern's chequerboard."""
        xp, width = self.backend.xp, self.wave.shape[1]

        def signs(y: Array, x: Array) -> Array:
            board = y + x
            along = (board, y + 0 * x, x + 0 * y, y // 2 + x)[number // 2]
            return (1 - 2 * ((board + along + number) % 2)).astype(np.int8)

        y, x = xp.arange(rows.start, rows.stop)[:, None], xp.arange(width)
        found, inside = signs(y, x), self._inside(rows, self.light)
        found[inside] = signs(y - moved[0], x - moved[1])[inside]
        return found

    def _inside(self, rows: slice, light: Tilt) -> tuple[slice, slice]:
        """The part of these rows that is not along the panel's edges, counted from the first of them."""
        (edge, side), (height, width) = light.edges, self.wave.shape
        first = max(edge, rows.start)
        last = max(min(height - edge, rows.stop), first)
        return slice(first - rows.start, last - rows.start), slice(side, width - side)

    def flat_phase(self, amplitude: Array, phase: Array) -> None:
        """Fill `phase` with that of the amplitude with flat phase, back at the panel; its amplitude there is lost.

        A better start than double phase where the panel does not reach a whole turn and the iris is open (WIDE).
        """
        self._fill_wave(amplitude, self.light)
        xp, wave = self.backend.xp, self.wave

        def work(worker: int, rows: slice) -> None:
            rooms = [room[: rows.stop - rows.start] for room in self.rooms[worker]]
            angle_into(xp, wave[rows].imag, wave[rows].real, phase[rows], rooms)

        self.backend.over_rows(len(phase), self.objective.strip, work)

    def _tilt(self, cycles: list[np.ndarray], half_open: bool) -> Tilt:
        """The tilt of light with these frequencies, cycles a pixel, at each row and each column of the image."""
        turned = [2 * math.pi * (np.cumsum(along) - along[0]) for along in cycles]
        ramp = [self.backend.xp.asarray(np.exp(1j * one).astype(self.wave.dtype)) for one in turned]
        tilt = Tilt(turned, ramp, (_rising(cycles[0]), _rising(cycles[1])))
        if not half_open:
            return tilt
        lift, edges = self._ends(tilt)
        return replace(tilt, lift=lift, edges=edges)

    def _ends(self, tilt: Tilt) -> tuple[Array, tuple[int, int]]:
        """`lift` and `edges` of a tilt, from an even image that goes back to the panel and forward again.

        The field that goes forward is complex: the mean of the fields of the two phases that double phase is made of.
        """
        xp, optics, wave = self.backend.xp, self.optics, self.wave
        self._wave(xp.ones(wave.shape, np.float32), tilt)
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
        rows, columns = (min(EDGES * n, middle) for n, middle in zip(whole, (down, across), strict=True))
        xp.clip(reached, FAINTEST, 1 / FAINTEST, out=reached)
        return 1 / reached, (rows, columns)

    def _wave(self, amplitude: Array, light: Tilt) -> None:
        """Fill `wave` with the factor on the beam that each pixel would need, of any scale."""
        xp, wave, over = self.backend.xp, self.wave, self.over_source
        lift = light.lift

        def tilt(worker: int, rows: slice) -> None:
            xp.multiply(amplitude[rows], light.ramp[0][rows, None], out=wave[rows])
            wave[rows] *= light.ramp[1]
            if lift is not None:
                wave[rows] *= lift[rows]

        def unlit(worker: int, rows: slice) -> None:
            wave[rows] *= over[rows]

        self.backend.over_rows(len(wave), self.objective.strip, tilt)
        self.optics.wave_at_panel(wave)
        if over is not None:
            self.backend.over_rows(len(wave), self.objective.strip, unlit)


def middle(path: LightPath) -> list[np.ndarray]:
    """Middle of the frequencies that the pupil passes, cycles a pixel, the same everywhere: [H], [W]."""
    return [np.full(n, opening(path, axis)[0]) for axis, n in enumerate(path.grid.shape)]


def tilted(path: LightPath, least: float) -> list[np.ndarray]:
    """Frequency of the light at each row and each column of an image that keeps more detail than one without a tilt.

    A picture's amplitude has frequencies of either sign, and those of one sign alone have all of its detail. So light
    whose middle frequency is aside of the middle of the pupil's opening carries more detail on that side. Without a
    tilt the descent does not find this: where the image's phase is flat, the gradient of what the pupil stops is zero.

    Tilted light comes from the side: along the edge where that is beyond the panel's end, the tilt rises slowly, over
    as much of the panel as there is (RISE_MOST). Along an axis on which that is less than `least` times as far as the
    light comes from, as at large distances, there is none; and none for an opening off the axis, whose pattern has a
    ramp that keeps the zero order out.

    Returns
    -------
    list of float array [H], [W], cycles a pixel
    """
    found = []
    openings = [opening(path, axis) for axis in (0, 1)]
    on_axis = not any(at for at, _ in openings)
    for axis, n in enumerate(path.grid.shape):
        at, half_width = openings[axis]
        aside = TILT * max(min(half_width, 1 - 3 * half_width), 0.0)
        pixels = shift(path, axis, at + aside) - shift(path, axis, at)
        rise = min(RISE * abs(pixels), RISE_MOST * n)
        if rise < least * abs(pixels) or not on_axis:
            aside = 0.0
        along = np.clip(np.arange(n) / max(rise, 1.0), 0, 1)
        found.append(at + math.copysign(aside, pixels) * along**2 * (3 - 2 * along))
    return found


def _rising(cycles: np.ndarray) -> slice:
    """From the first to the last place at which a row of values changes; empty where it does not."""
    places = np.flatnonzero(np.diff(cycles))
    return slice(int(places[0]), int(places[-1]) + 2) if len(places) else slice(0)


def opening(path: LightPath, axis: int) -> tuple[float, float]:
    """Middle and half-width of the frequencies that the strongest mode's pupil passes, cycles a pixel."""
    passed = np.abs(path.transfers[int(np.argmax(path.weights))]) ** 2
    share = passed.sum(1 - axis) / max(float(passed.sum()), 1e-30)
    cycles = np.asarray(path.grid.frequency_index(axis)) / path.grid.padded[axis]
    at = float(share @ cycles)
    # What a symmetric opening loses to aberrations or rounding is no reason for a ramp.
    at = at if abs(at) > 0.02 * float(cycles[-1]) else 0.0
    return at, math.sqrt(3 * float(share @ (cycles - at) ** 2))


def shift(path: LightPath, axis: int, cycles: float) -> float:
    """How far (pixels) from its place in the image light of a frequency leaves the panel, towards lower indices."""
    transfer = path.transfers[int(np.argmax(path.weights))]
    index = np.asarray(path.grid.frequency_index(axis))
    at = [int(np.argmin(np.abs(np.asarray(path.grid.frequency_index(a))))) for a in (0, 1)]
    at[axis] = min(int(np.argmin(np.abs(index - cycles * path.grid.padded[axis]))), len(index) - 2)
    beside = list(at)
    beside[axis] += 1
    step = complex(transfer[tuple(beside)] * np.conj(transfer[tuple(at)]))
    return -math.atan2(step.imag, step.real) * path.grid.padded[axis] / (2 * math.pi)
