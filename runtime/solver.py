"""The pattern whose light through a calibrated path is nearest to a picture, in a fixed number of steps.

What is minimised is the squared error of amplitude, sqrt(I) against sqrt(target), on what pixels of the
panel's size integrate, with the scale between the two in closed form at every step. Gradients are the light
path's own adjoint (seed eq. 20-23), so leaks, uneven beams, crosstalk, coherence and ghosts are compensated
as far as light allows.

Start: double phase (Hsueh and Sawchuk 1978; Maimone et al. 2017) of the back-propagated picture with flat
phase, which keeps the picture's phase smooth and so free of speckle. Steps: memoryless BFGS (Shanno 1978;
L-BFGS with one pair), one forward and one adjoint pass each, no line search; the best pattern met is the one
returned, so more iterations never give a worse one, up to the rounding to gray levels. Where phases a turn
apart are not alike (crosstalk mixes them; a drive of less than a turn lacks some), steps are projected onto
the panel's range, and pixels that are pushed out of it stay out of the curvature (Bertsekas 1982).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath import (
    FINE,
    LightPath,
    back_propagated,
    irradiance,
    irradiance_and_pullback,
    panel_phase,
    pixel_irradiance,
    pixel_irradiance_adjoint,
)

FLOOR = 1e-4  # of the mean light: added before the square root, whose slope is unbounded in the dark
FIRST_STEP = 0.5  # of the Gauss-Newton step for a path that loses no light
LONGEST = 0.5  # step of a pixel, rad, where its range has ends
LOUD = 0.98  # share of pixels whose amplitude double phase reproduces; brighter ones are cut

Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class Quality:
    """How near irradiance is to a target, up to one scale.

    psnr_db: of amplitude, the target's brightest as the peak. nrmse: root mean squared error of irradiance
    over the target's standard deviation. scale: irradiance a unit of target.
    """

    psnr_db: float
    nrmse: float
    scale: float


@dataclass(frozen=True)
class Solution:
    """A pattern for one colour and plane.

    gray: uint8 [H, W]. phase: what was asked of the panel before rounding, rad, float [H, W]. quality: of the
    gray levels, through the whole path. psnr_db: before rounding, at the start and after each iteration.
    """

    gray: np.ndarray
    phase: np.ndarray
    quality: Quality
    psnr_db: tuple[float, ...]


def solve(
    path: LightPath,
    target: np.ndarray,
    iterations: int = 20,
    levels: int = 256,
    start: np.ndarray | None = None,
    progress: Progress | None = None,
) -> Solution:
    """The best pattern met in `iterations` steps towards a target irradiance [H, W] of any scale.

    levels: gray levels that may be used, from 0 on. start: phase (rad) [H, W] to begin from; none: double
    phase. progress: called with the iterations done and the amplitude PSNR so far, dB. Raises InputError for
    a target of another size, with negative or non-finite values or all dark, and for counts that are out of
    range.
    """
    amplitude = _checked_amplitude(path, target)
    if iterations < 0:
        raise InputError(f"{iterations} iterations: give 0 (the start alone) or more")
    drive = DriveRange(path, levels)
    if start is None:
        start = double_phase(path, target) if drive.gapless else flat_phase(path, target)
    phase = drive.held(np.array(start, amplitude.dtype))
    descent = _Descent(path, amplitude, drive)
    history: list[float] = []
    for done in range(iterations + 1):
        history.append(descent.look(phase))
        if progress:
            progress(done, max(history))
        if done < iterations:
            phase = descent.step(phase)
    gray = drive.gray(descent.best_phase)
    return Solution(gray, descent.best_phase, quality_of(path, gray, target), tuple(history))


def quality_of(path: LightPath, gray: np.ndarray, target: np.ndarray) -> Quality:
    """What gray levels [H, W] show through a path, against a target irradiance [H, W]."""
    phase = panel_phase(path, gray.astype(np.int64))
    return quality(pixel_irradiance(path, irradiance(path, phase)), target)


def quality(light: np.ndarray, target: np.ndarray) -> Quality:
    """How near irradiance is to a target, both [H, W], each error with its own best scale."""
    root = np.sqrt(np.maximum(light, 0), dtype=np.float64)
    wanted = np.sqrt(target, dtype=np.float64)
    residual = root * (float(np.vdot(root, wanted)) / max(float(np.vdot(root, root)), 1e-300)) - wanted
    psnr = 20 * math.log10(wanted.max() / max(float(np.sqrt(np.mean(residual**2))), 1e-150))
    shown, asked = light.astype(np.float64), target.astype(np.float64)
    scale = float(np.vdot(shown, asked)) / max(float(np.vdot(asked, asked)), 1e-300)
    fitted = shown * (float(np.vdot(shown, asked)) / max(float(np.vdot(shown, shown)), 1e-300))
    spread = max(float(asked.std()), 1e-6 * float(asked.max()))
    return Quality(psnr, float(np.sqrt(np.mean((fitted - asked) ** 2))) / spread, scale)


def double_phase(path: LightPath, target: np.ndarray) -> np.ndarray:
    """Phase (rad) [H, W] that shows a target irradiance [H, W] at once, without iterations.

    The target's amplitude with flat phase goes back to the panel; there a pixel's complex amplitude a exp(j
    t), a <= 1, is the mean of exp(j (t + acos a)) and exp(j (t - acos a)), which alternate as on a
    chequerboard.
    """
    wave, lit = _wave_at_panel(path, target)
    size = np.abs(wave)
    rank = min(size.size - 1, int(LOUD * size.size))
    wave = wave / max(float(np.partition(size, rank, axis=None)[rank]), 1e-30)
    if path.leak is not None:
        wave = wave - path.leak * lit
    spread = np.arccos(np.minimum(np.abs(wave), 1))
    spread[::2, 1::2] *= -1
    spread[1::2, ::2] *= -1
    return np.angle(wave) + spread


def flat_phase(path: LightPath, target: np.ndarray) -> np.ndarray:
    """Phase (rad) [H, W] of the target's amplitude with flat phase, taken back; its amplitude there is lost.

    A better start than double phase where the panel does not reach a whole turn.
    """
    return np.angle(_wave_at_panel(path, target)[0])


def _wave_at_panel(path: LightPath, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the pixels would have to do to the beam, complex [H, W] of any scale; and 1 / source, bounded."""
    amplitude = _checked_amplitude(path, target)
    mode = int(np.argmax(path.weights))
    wave = back_propagated(path, _on_fine_grid(path, amplitude).astype(path.source.dtype), mode)
    tiny = 1e-3 * np.sqrt(np.mean(np.abs(path.source) ** 2)) + 1e-30
    lit = np.conj(path.source) / np.maximum(np.abs(path.source), tiny) ** 2
    return wave * lit, lit


class DriveRange:
    """The phases that the panel can be driven to, and the gray levels that do it.

    levels: gray levels that may be used, from 0 on; more than the response holds are not.
    """

    def __init__(self, path: LightPath, levels: int = 256) -> None:
        if not 2 <= levels <= 256:
            raise InputError(f"{levels} gray levels: give from 2 to 256")
        response = path.response[:levels]
        self.order = np.argsort(response).astype(np.uint8)
        self.sorted = response[self.order]
        self.between = (self.sorted[1:] + self.sorted[:-1]) / 2
        self.gain = None if path.gain is None else np.maximum(path.gain, 1e-3)
        low, high = self.sorted[0], self.sorted[-1]
        self.low = low if self.gain is None else low * self.gain
        self.high = high if self.gain is None else high * self.gain
        step = (high - low) / (len(response) - 1)
        # Where a whole turn is covered, phases beyond the ends come back inside; one step is no gap.
        gap = 2 * math.pi - np.min(self.high - self.low)
        self.gapless = bool(gap <= 1.5 * step)
        self.bounded = path.crosstalk is not None or not self.gapless

    def held(self, phase: np.ndarray) -> np.ndarray:
        """Phases (rad) moved by whole turns into what the panel reaches; in a gap, to its nearer edge."""
        turn = phase.dtype.type(2 * math.pi)
        above = (phase - self.low) / turn
        outside = (phase < self.low) | (phase > self.high)
        phase = np.where(outside, phase - turn * np.floor(above), phase)
        past = phase - self.high
        return np.where(past <= 0, phase, np.where(past <= self.low + turn - phase, self.high, self.low))

    def pushed_out(self, phase: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Where a step down the gradient would leave the range from its very edge, bool [H, W]."""
        return ((phase <= self.low) & (gradient > 0)) | ((phase >= self.high) & (gradient < 0))

    def gray(self, phase: np.ndarray) -> np.ndarray:
        """Gray levels, uint8 [H, W], whose phase is nearest to `phase` (rad)."""
        asked = self.held(phase)
        if self.gain is not None:
            asked = asked / self.gain
        return self.order[np.searchsorted(self.between, asked)]


class _Descent:
    """Memoryless BFGS on the amplitude error, keeping the best phase met."""

    def __init__(self, path: LightPath, amplitude: np.ndarray, drive: DriveRange) -> None:
        self.path, self.drive = path, drive
        self.amplitude = amplitude
        self.real = amplitude.dtype.type
        self.floor: float | None = None
        self.best_loss, self.best_phase = math.inf, amplitude
        self.first = FIRST_STEP / float(np.mean(np.abs(path.source) ** 2))
        self.before: np.ndarray | None = None
        self.move: np.ndarray | None = None

    def look(self, phase: np.ndarray) -> float:
        """Amplitude PSNR (dB) of a phase; keeps it if it is the best, and what a step from it needs."""
        image, self.pullback = irradiance_and_pullback(self.path, phase)
        light = pixel_irradiance(self.path, image)
        if self.floor is None:
            self.floor = FLOOR * float(np.mean(light))
            self.wanted = np.sqrt(self.amplitude**2 + self.real(FLOOR * float(np.mean(self.amplitude**2))))
            self.peak = float(self.wanted.max())
        root = np.sqrt(np.maximum(light, 0) + self.real(self.floor))
        self.scale = float(np.vdot(root, self.wanted) / np.vdot(root, root))
        error = root * self.real(self.scale) - self.wanted
        loss = float(np.vdot(error, error)) / error.size
        if loss < self.best_loss:
            self.best_loss, self.best_phase = loss, phase
        self.slope = error / root * self.real(self.scale)
        return 20 * math.log10(self.peak / max(math.sqrt(loss), 1e-30))

    def step(self, phase: np.ndarray) -> np.ndarray:
        """The next phase; held within what the panel reaches where phases a turn apart are not alike."""
        slope = self.pullback(pixel_irradiance_adjoint(self.path, self.slope))
        gradient, change, before = slope, None, self.move
        if self.before is not None:
            change = slope - self.before
        self.before = slope
        if self.drive.bounded:
            free = ~self.drive.pushed_out(phase, slope)
            gradient = gradient * free
            if change is not None and before is not None:
                change, before = change * free, before * free
        move = None
        if change is not None and before is not None:
            sy, yy = float(np.vdot(before, change)), float(np.vdot(change, change))
            if sy > 1e-12 * yy:
                gamma, along = sy / yy, float(np.vdot(before, gradient)) / sy
                beta = gamma * (float(np.vdot(change, gradient)) - along * yy) / sy
                move = (
                    self.real(-gamma) * gradient
                    + self.real(gamma * along) * change
                    + self.real(beta - along) * before
                )
        if move is None:
            move = self.real(-self.first / self.scale**2) * gradient
        if not self.drive.bounded:
            self.move = move
            return phase + move
        moved = np.clip(phase + np.clip(move, -LONGEST, LONGEST), self.drive.low, self.drive.high)
        self.move = moved - phase
        return moved


def _checked_amplitude(path: LightPath, target: np.ndarray) -> np.ndarray:
    """Square root of a target, in the path's precision and of mean square 1. Raises InputError."""
    target = np.asarray(target)
    if target.shape != path.grid.shape:
        raise InputError(
            f"the target is {' x '.join(map(str, target.shape))} (height x width) and the panel "
            f"{path.grid.shape[0]} x {path.grid.shape[1]}: resize or fit the picture"
        )
    if not np.isfinite(target).all() or target.min() < 0:
        raise InputError("the target has negative or non-finite values: irradiance is never below zero")
    if not target.max() > 0:
        raise InputError("the target is all dark: any pattern shows some light, so give it a bright pixel")
    dtype = path.response.dtype
    return np.sqrt(target / np.mean(target, dtype=np.float64)).astype(dtype)


def _on_fine_grid(path: LightPath, amplitude: np.ndarray) -> np.ndarray:
    """Amplitude [H, W] between pixel centres by straight lines, zero in the margin: [*grid.image_shape]."""
    height, width = path.grid.shape
    first = FINE * path.grid.margin
    fine = np.zeros(path.grid.image_shape, amplitude.dtype)
    inner = fine[first : first + FINE * height, first : first + FINE * width]
    inner[::2, ::2] = amplitude
    inner[1::2, ::2] = (amplitude + np.concatenate((amplitude[1:], amplitude[-1:]))) / 2
    inner[:, 1:-1:2] = (inner[:, :-2:2] + inner[:, 2::2]) / 2
    inner[:, -1] = inner[:, -2]
    return fine
