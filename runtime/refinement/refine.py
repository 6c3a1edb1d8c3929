"""Refinement of one picture while it is displayed: pattern and approximator follow what the camera captures.

Every capture does two things. The captured picture y takes the place of the simulated one D(I) in the gradient of the
pattern: the residual is the camera's, the derivatives are the model's (seed eq. 18 with D(|z|^2) measured). And D is
drawn towards y through the exported gradients over its adapters, by Adam (Kingma and Ba 2015) in NumPy.

Every third capture is held out: the adapters never learn from it. When they predict the last of these worse than they
did before, they are put back to where they predicted best, and the refinement stops. Of each colour the pattern that
the camera liked best is the one that stays. The inputs are patterns and pictures; lasers are out of reach.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import IO

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath, pixel_irradiance
from runtime.lightpath.light_path_adjoint import irradiance_and_pullback, pixel_irradiance_adjoint
from runtime.networks.onnx_approximator import EPSILON, Approximator
from runtime.solver import DriveRange, quality

HOLD_OUT = 3  # every third capture, the first included
KEPT = 3  # held-out captures that are judged by: the pattern moves on, and old ones with it
LEARNING = 4  # steps of the adapters a capture
RATE, FORGET, FORGET_SQUARES = 1e-3, 0.8, 0.95  # of Adam; short memories, since what is learned from changes
STEP = 1.0  # of the Gauss-Newton step of the pattern
WORSE_DB = 0.3  # below the best pattern: that one again, and half the step from there
PATIENCE = 2  # held-out captures in a row that the adapters may predict worse than the best ones do
RISE = 1e-3  # relative: less is no rise

See = Callable[[np.ndarray], np.ndarray]
Pullback = Callable[[np.ndarray], np.ndarray]
Weights = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Step:
    """What one capture came to; a line of the drift log.

    number: from 1 on. held_out: whether the adapters were kept from it. psnr_db: amplitude PSNR of the captured picture
    against the target, mean over colours. predicted: error of D on this capture before it was learned from; heldout: on
    the last held-out captures, when the newest of them was taken; both are mean squared differences of amplitude.
    drift: change of the adapters since the export, over their size. stopped: why the refinement has ended, or none.
    """

    number: int
    held_out: bool
    psnr_db: float
    predicted: float
    heldout: float
    drift: float
    stopped: str | None


class Refinement:
    """The state of one picture's refinement.

    paths: a light path a colour. target: irradiance to show, [C, H, W], any scale. phase: of the pattern to begin
    with, rad, [C, H, W]. log: a text stream for one line of JSON a capture, or none. Raises InputError where the
    approximator cannot be refined or sizes differ.

    Attributes: phase (of the pattern that is to be shown next), steps, stopped.
    """

    def __init__(
        self,
        paths: Sequence[LightPath],
        approximator: Approximator,
        target: np.ndarray,
        phase: np.ndarray,
        log: IO[str] | None = None,
    ) -> None:
        shape = (len(paths), *paths[0].grid.shape)
        if not approximator.refinable:
            raise InputError(
                "the bundle's approximator has no adapters to refine: export it again with this release's trainer"
            )
        if not shape == approximator.shape == target.shape == phase.shape:
            raise InputError(
                f"light paths are for {shape}, the approximator for {approximator.shape}, the target is "
                f"{target.shape} and the pattern {phase.shape}: give all of one size (colours, rows, columns)"
            )
        self.paths, self.approximator, self.log = paths, approximator, log
        self.target = np.asarray(target, np.float32)
        self.drives = [DriveRange(path) for path in paths]
        self.steps: list[Step] = []
        self.stopped: str | None = None
        self._exported = _copied(approximator.adapters)
        self._first_phase = np.array(phase, np.float32)
        self._held: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=KEPT)
        self.rollback()

    def rollback(self) -> None:
        """Back to the exported adapters and the first pattern, as if nothing had been captured; the log stays."""
        self._put(self._exported)
        self._best = _copied(self._exported)
        self._adam = _Adam(self._exported)
        self._held.clear()
        self._heldout = math.inf
        self._rises = 0
        self.phase = self._first_phase.copy()
        self.best_phase = self.phase.copy()
        self._best_psnr, self._step = np.full(len(self.paths), -np.inf), np.full(len(self.paths), STEP)
        self.stopped = None

    @property
    def gray(self) -> np.ndarray:
        """The pattern to show: the next one to be tried, or after the end the best; uint8 [C, H, W]."""
        phase = self.best_phase if self.stopped else self.phase
        return np.stack([d.gray(p) for d, p in zip(self.drives, phase, strict=True)])

    @property
    def best_psnr_db(self) -> float:
        """What the camera saw of the best pattern of each colour, mean over colours."""
        return float(self._best_psnr.mean())

    def take(self, captured: np.ndarray) -> Step:
        """Learn from what the camera saw of `gray`, irradiance [C, H, W] of any scale, and choose the next pattern.

        Raises InputError after the end, or for a picture of another size.
        """
        if self.stopped:
            raise InputError(f"the refinement has ended ({self.stopped}): roll it back to begin again")
        if captured.shape != self.target.shape:
            raise InputError(
                f"the captured picture is {captured.shape} and not {self.target.shape}: register it"
            )
        number, held = len(self.steps) + 1, len(self.steps) % HOLD_OUT == 0
        simulated, pullbacks = self._simulated(self.phase)
        seen = self._scaled(simulated, np.maximum(captured, 0))
        predicted = self._error(simulated, seen)
        if held:
            self._held.append((simulated, seen))
            self._heldout = self._watch()
        else:
            self._learn(simulated, seen)
        psnr = np.array(
            [quality(np.maximum(y, 0), t).psnr_db for y, t in zip(captured, self.target, strict=True)]
        )
        better, worse = psnr > self._best_psnr, psnr < self._best_psnr - WORSE_DB
        self.best_phase[better], self._best_psnr[better] = self.phase[better], psnr[better]
        self._step[worse] /= 2
        moved = self._moved(simulated, seen, pullbacks)
        self.phase = np.where(worse[:, None, None], self.best_phase, moved).astype(np.float32)
        step = Step(number, held, float(psnr.mean()), predicted, self._heldout, self._drift(), self.stopped)
        self.steps.append(step)
        if self.log:
            self.log.write(json.dumps(asdict(step)) + "\n")
            self.log.flush()
        return step

    def _simulated(self, phase: np.ndarray) -> tuple[np.ndarray, list[Pullback]]:
        """Irradiance of mean 1 on the panel's pixels, and the way from a gradient over it to a Gauss-Newton step."""
        light, back = np.zeros_like(self.target), []
        for c, path in enumerate(self.paths):
            image, pullback = irradiance_and_pullback(path, phase[c])
            pixels = pixel_irradiance(path, image)
            light[c] = pixels / pixels.mean()
            back.append(_to_step(path, pullback))
        return light, back

    def _scaled(self, simulated: np.ndarray, captured: np.ndarray) -> np.ndarray:
        """A captured picture, each colour scaled to what D makes of the simulated one."""
        self._look(simulated, captured)
        return np.stack([_matched(y, d) for y, d in zip(captured, self.approximator.corrected, strict=True)])

    def _look(self, simulated: np.ndarray, target: np.ndarray) -> float:
        self.approximator.irradiance[...] = simulated
        self.approximator.target[...] = target
        return self.approximator.look()

    def _error(self, simulated: np.ndarray, seen: np.ndarray) -> float:
        """Mean squared difference of amplitude between D of a simulated picture and the captured one."""
        return self._look(simulated, seen) / seen.size

    def _learn(self, simulated: np.ndarray, seen: np.ndarray) -> None:
        for _ in range(LEARNING):
            self._look(simulated, seen)
            self._adam.step(self.approximator.adapters, self.approximator.adapter_gradients())

    def _watch(self) -> float:
        """The held-out error; keeps the best adapters, and ends the refinement where it rises."""
        now = self._held_error()
        current = _copied(self.approximator.adapters)
        self._put(self._best)
        best = self._held_error()
        if now <= best:
            self._best = current
        self._rises = self._rises + 1 if now > best * (1 + RISE) else 0
        if self._rises >= PATIENCE:
            self.stopped = "the held-out error rises"
            return best
        self._put(current)
        return now

    def _held_error(self) -> float:
        return float(np.mean([self._error(simulated, seen) for simulated, seen in self._held]))

    def _moved(self, simulated: np.ndarray, seen: np.ndarray, pullbacks: list[Pullback]) -> np.ndarray:
        """The next pattern: one step down the gradient with the captured picture in place of the simulated one."""
        self._look(simulated, seen)
        made = _amplitude(self.approximator.corrected)
        wanted = np.stack([_matched(t, y) for t, y in zip(self.target, seen, strict=True)])
        # The network subtracts a target from what it makes itself: this one leaves the camera's residual.
        instead = np.maximum(made - _amplitude(seen) + _amplitude(wanted), 0) ** 2 - EPSILON
        self._look(simulated, np.maximum(instead, 0))
        moved = [
            drive.held(p - np.float32(length) * back(slope.copy()))
            for drive, p, length, back, slope in zip(
                self.drives, self.phase, self._step, pullbacks, self.approximator.slope, strict=True
            )
        ]
        return np.stack(moved)

    def _put(self, weights: Weights) -> None:
        for name, weight in weights.items():
            self.approximator.adapters[name][...] = weight

    def _drift(self) -> float:
        adapters = self.approximator.adapters
        moved = sum(float(((adapters[n] - w) ** 2).sum()) for n, w in self._exported.items())
        size = sum(float((w**2).sum()) for w in self._exported.values())
        return math.sqrt(moved / size) if size > 0 else math.sqrt(moved)


def refine(refinement: Refinement, see: See, captures: int) -> list[Step]:
    """Show, capture and learn, at most so many times; ends with the best pattern shown. Returns the steps.

    see: shows gray levels [C, H, W] and returns what the camera saw of them, irradiance [C, H, W].
    """
    for _ in range(captures):
        if refinement.take(see(refinement.gray)).stopped:
            break
    else:
        refinement.stopped = "all captures are taken"
    see(refinement.gray)
    return refinement.steps


def _to_step(path: LightPath, pullback: Pullback) -> Pullback:
    """From a gradient over pixels of mean irradiance 1 to the step over phase, for a path that loses no light."""
    power = float(np.mean(np.abs(path.source) ** 2))
    return lambda slope: pullback(pixel_irradiance_adjoint(path, slope)) / power


class _Adam:
    """Moments of gradients, and steps from them."""

    def __init__(self, weights: Weights) -> None:
        self.mean = {n: np.zeros_like(w) for n, w in weights.items()}
        self.square = {n: np.zeros_like(w) for n, w in weights.items()}
        self.count = 0

    def step(self, weights: Weights, gradients: Weights) -> None:
        """Change weights in place."""
        self.count += 1
        for name, weight in weights.items():
            gradient = gradients[name]
            self.mean[name] += (1 - FORGET) * (gradient - self.mean[name])
            self.square[name] += (1 - FORGET_SQUARES) * (gradient**2 - self.square[name])
            mean = self.mean[name] / (1 - FORGET**self.count)
            square = self.square[name] / (1 - FORGET_SQUARES**self.count)
            weight -= RATE * mean / (np.sqrt(square) + 1e-12)


def _copied(weights: Weights) -> dict[str, np.ndarray]:
    return {name: weight.copy() for name, weight in weights.items()}


def _amplitude(light: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(light, 0) + EPSILON)


def _matched(light: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Light [H, W] scaled so that its amplitude is nearest to that of a reference."""
    root, wanted = np.sqrt(light), np.sqrt(np.maximum(reference, 0))
    scale = float(np.vdot(root, wanted)) / max(float(np.vdot(root, root)), 1e-30)
    return light * np.float32(scale**2)
