"""Where a solve begins: double phase, flat phase, or the frame before, moved as its content has moved."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from runtime.lightpath.light_path import LightPath
from runtime.solver.in_place_path import Optics
from runtime.solver.objective import Objective

Array = Any

LOUD = 0.98  # share of pixels whose amplitude double phase reproduces; brighter ones are cut
LOOKED_AT = 5  # every so many pixels, an axis, are ranked for that
CUT = 0.7  # of the contrast: a frame that differs by more from the one before, moved, is another scene
PATCH = 512  # side of the part that motion is found in
FAINTEST = 0.7  # of the amplitude in the middle: fainter edges of the image are not made up for any further
EDGES = 3  # times as far in as the panel's end darkens an even image, edges of a frame begin anew
WIDE = 0.9  # of the panel's band: with a wider iris double phase errs by more than its edges


class Start:
    """First phases for an objective, in place.

    ramp: tilt (cycles a pixel; rows, columns) of the light in the image, for a pupil whose opening is off the
    axis: the middle of what it passes. lift [H, W]: what an amplitude is multiplied by, since the panel ends and
    the edges of an image get only part of their light. edges: how far in that goes, pixels (rows, columns). Both only
    where `doubled`, the start being double phase, and where the iris is not open: `WIDE`.
    """

    def __init__(self, objective: Objective, path: LightPath, colour: int, doubled: bool) -> None:
        xp = objective.backend.xp
        self.backend, self.objective, self.colour = objective.backend, objective, colour
        self.optics: Optics = objective.optics[colour][0]
        height, width = path.grid.shape
        pair = path.source.dtype
        self.wave = xp.zeros((height, width), pair)
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
            self._see_edges()

    def double_phase(self, amplitude: np.ndarray, phase: Array) -> None:
        """Fill `phase` (rad) [H, W] with a pattern that shows an amplitude [H, W] at once, without iterations.

        The amplitude with flat phase goes back to the panel; there a pixel's complex amplitude a exp(j t),
        a <= 1, is the mean of exp(j (t + acos a)) and exp(j (t - acos a)), which alternate as on a chequerboard
        (Hsueh and Sawchuk 1978; Maimone et al. 2017).
        """
        self._wave(amplitude)
        xp, wave = self.backend.xp, self.wave
        some = xp.abs(wave[::LOOKED_AT, ::LOOKED_AT]).ravel()
        rank = min(some.size - 1, int(LOUD * some.size))
        loud = 1 / max(float(xp.partition(some, rank)[rank]), 1e-30)
        unmodulated = self.unmodulated

        def work(worker: int, rows: slice) -> None:
            part, new = self.objective.part[worker][: rows.stop - rows.start], phase[rows]
            here = wave[rows]
            here *= loud
            if unmodulated is not None:
                here -= unmodulated[rows]
            xp.abs(here, out=part)
            xp.minimum(part, 1, out=part)
            xp.arccos(part, out=part)
            odd = rows.start % 2
            part[odd::2, 1::2] *= -1
            part[1 - odd :: 2, ::2] *= -1
            xp.arctan2(here.imag, here.real, out=new)
            new += part

        self.backend.over_rows(len(phase), self.objective.strip, work)

    def flat_phase(self, amplitude: np.ndarray, phase: Array) -> None:
        """Fill `phase` with that of the amplitude with flat phase, taken back; its amplitude there is lost.

        A better start than double phase where the panel does not reach a whole turn.
        """
        self._wave(amplitude)
        xp, wave = self.backend.xp, self.wave

        def work(worker: int, rows: slice) -> None:
            xp.arctan2(wave[rows].imag, wave[rows].real, out=phase[rows])

        self.backend.over_rows(len(phase), self.objective.strip, work)

    def _see_edges(self) -> None:
        """Find `lift` and `edges` from an even image taken back to the panel and forth again.

        What goes forth is complex: the mean of the fields of the two phases that double phase is made of.
        """
        xp, optics, wave = self.backend.xp, self.optics, self.wave
        self._wave(np.ones(wave.shape, np.float32))
        size, angle = xp.abs(wave), xp.arctan2(wave.imag, wave.real)
        size /= size.max()
        xp.arccos(size, out=size)
        light, mode = xp.zeros(wave.shape, angle.dtype), optics.strongest
        optics.forward(angle + size, light)
        wave[...] = optics.fields[mode][optics.at_pixels]
        optics.forward(angle - size, light)
        wave += optics.fields[mode][optics.at_pixels]
        reached = xp.abs(wave)
        reached /= max(float(xp.median(reached[::LOOKED_AT, ::LOOKED_AT])), 1e-30)
        down, across = (n // 2 for n in wave.shape)
        whole = (int(xp.argmax(along >= 1)) for along in (reached[:, across], reached[down]))
        self.edges = tuple(min(EDGES * n, middle) for n, middle in zip(whole, (down, across), strict=True))
        xp.clip(reached, FAINTEST, 1 / FAINTEST, out=reached)
        self.lift = 1 / reached

    def _wave(self, amplitude: np.ndarray) -> None:
        """What the pixels would have to do to the beam, of any scale."""
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


def shifted(before: Array, motion: tuple[int, int], out: Array) -> None:
    """`before` [..., H, W] moved by (down, right) pixels into `out`; what leaves one side comes in at the other."""
    height, width = before.shape[-2:]
    dy, dx = motion[0] % height, motion[1] % width
    for to_rows, from_rows in (
        (slice(dy, None), slice(0, height - dy)),
        (slice(0, dy), slice(height - dy, None)),
    ):
        for to, of in ((slice(dx, None), slice(0, width - dx)), (slice(0, dx), slice(width - dx, None))):
            out[..., to_rows, to] = before[..., from_rows, of]


def renewed(motion: tuple[int, int], edges: tuple[int, int], shape: tuple[int, int]) -> list[tuple[Any, ...]]:
    """The parts of a panel [..., H, W] that begin anew where content moves by (down, right).

    Where content comes in there is nothing to go on from; and along its edges a pattern makes up for the
    panel's end, which does not move. Left alone, both grow into speckle within a few frames.
    """
    parts: list[tuple[Any, ...]] = []
    for axis, (step, edge, count) in enumerate(zip(motion, edges, shape, strict=True)):
        first, last = (min(max(edge, way * step), count) for way in (1, -1))
        for part in (slice(0, first), slice(count - last, count)):
            if part.stop > part.start:
                parts.append((..., part, slice(None)) if axis == 0 else (..., part))
    return parts


def motion_between(before: np.ndarray, after: np.ndarray) -> tuple[int, int]:
    """How far content has moved as a whole from one picture [H, W] to the next: (down, right), pixels.

    Phase correlation (Kuglin and Hines 1975) of the middle of the pictures; at most a quarter of that.
    """
    first = [(n - min(n, PATCH)) // 2 for n in before.shape]
    patch = tuple(slice(f, f + min(n, PATCH)) for f, n in zip(first, before.shape, strict=True))
    window = [np.hanning(p.stop - p.start)[..., None] for p in patch]
    edge = window[0] * window[1].T
    a, b = (np.fft.rfft2((x[patch] - x[patch].mean()) * edge) for x in (before, after))
    cross = b * np.conj(a)
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12 * np.abs(cross).max() + 1e-300), edge.shape)
    place = np.unravel_index(int(np.argmax(peak)), edge.shape)
    moved = [int(p) - n if p > n // 2 else int(p) for p, n in zip(place, edge.shape, strict=True)]
    if any(abs(m) > n // 4 for m, n in zip(moved, edge.shape, strict=True)):
        return 0, 0
    return moved[0], moved[1]


def is_cut(before: np.ndarray, after: np.ndarray, motion: tuple[int, int]) -> bool:
    """Whether a picture [H, W] is of another scene than the one before, moved."""
    step = max(1, min(before.shape) // 64)
    moved = np.roll(before[::step, ::step], [round(m / step) for m in motion], (0, 1))
    now = after[::step, ::step]
    contrast = max(float(now.std()), float(moved.std()), 1e-12)
    return float(np.sqrt(np.mean((now - moved) ** 2))) > CUT * contrast


def _turns(cycles: float, count: int, pair: Any) -> np.ndarray:
    """exp(2 pi i cycles n) at `count` pixels."""
    return np.exp(2j * math.pi * cycles * np.arange(count)).astype(pair)
