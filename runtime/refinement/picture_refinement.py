"""Refinement of one picture while it is displayed: pattern and approximator follow what the camera captures.

Every capture does two things. The captured picture y replaces the simulated picture D(I) in the gradient of the
pattern: the residual is the camera's, the derivatives are the model's (Chakravarthula et al. 2020, eq. 18, with
D(|z|^2) measured). And D learns y (adapter_learning).

Every third capture is held out: D never learns from it. When D predicts the latest held-out captures worse than before,
the refinement stops. For each colour, the pattern with the best capture is kept. The inputs are
patterns and pictures; nothing here can change the lasers.

References
----------
Chakravarthula et al. 2020, eq. 18.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import IO

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath, pixel_irradiance
from runtime.lightpath.light_path_adjoint import irradiance_and_pullback, pixel_irradiance_adjoint
from runtime.networks.onnx_approximator import EPSILON, Approximator
from runtime.refinement.adapter_learning import AdapterLearning
from runtime.solver import DriveRange, quality

HOLD_OUT = 3  # every third capture, the first included
STEP = 1.0  # of the Gauss-Newton step of the pattern
WORSE_DB = 0.3  # a pattern so far below the best: go back to the best, with half the step

ShowAndCapture = Callable[[np.ndarray], np.ndarray]
Pullback = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RefinementStep:
    """The result of one capture: a line of the drift log.

    Attributes
    ----------
    number : int
        From 1 on.
    held_out : bool
        The adapters did not learn from this capture.
    psnr_db : float, dB
        Amplitude PSNR of the captured picture against the target, mean over colours.
    predicted : float
        Error of D on this capture before it learned from it: mean squared difference of amplitude.
    heldout : float
        The same error on the latest held-out captures, when the newest of them was taken.
    drift : float
        Change of the adapters since the export, over their size.
    stopped : str or None
        Why the refinement has ended.
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

    Parameters
    ----------
    paths : sequence of LightPath
        A light path for each colour.
    approximator : Approximator
        The network D with adapters; its adapters are changed in place.
    target : array [C, H, W]
        Irradiance to show, of any scale.
    phase : array [C, H, W], rad
        Phase of the first pattern.
    log : text stream or None
        Gets one line of JSON for each capture.

    Attributes
    ----------
    phase : float32 array [C, H, W], rad
        Phase of the pattern that is to be shown next.
    steps : list of RefinementStep
    stopped : str or None
        Why the refinement has ended.

    Raises
    ------
    InputError
        Where the approximator cannot be refined or sizes differ.
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
        self.steps: list[RefinementStep] = []
        self.stopped: str | None = None
        self._learning = AdapterLearning(approximator)
        self._first_phase = np.array(phase, np.float32)
        self.rollback()

    def rollback(self) -> None:
        """Go back to the exported adapters and the first pattern, as without any capture; keeps the log."""
        self._learning.reset()
        self.phase = self._first_phase.copy()
        self.best_phase = self.phase.copy()
        self._best_psnr, self._step = np.full(len(self.paths), -np.inf), np.full(len(self.paths), STEP)
        self.stopped = None

    @property
    def gray(self) -> np.ndarray:
        """The pattern to show next, or after the end the best; uint8 [C, H, W]."""
        phase = self.best_phase if self.stopped else self.phase
        return np.stack([d.gray(p) for d, p in zip(self.drives, phase, strict=True)])

    @property
    def best_psnr_db(self) -> float:
        """Amplitude PSNR of the best capture of each colour, dB, mean over colours."""
        return float(self._best_psnr.mean())

    def take(self, captured: np.ndarray) -> RefinementStep:
        """Learn from a capture of `gray` and choose the next pattern.

        Parameters
        ----------
        captured : array [C, H, W]
            Irradiance of the captured picture, of any scale.

        Raises
        ------
        InputError
            After the end, or for a picture of another size.
        """
        if self.stopped:
            raise InputError(f"the refinement has ended ({self.stopped}): roll it back to begin again")
        if captured.shape != self.target.shape:
            raise InputError(
                f"the captured picture is {captured.shape} and not {self.target.shape}: register it"
            )
        number, held = len(self.steps) + 1, len(self.steps) % HOLD_OUT == 0
        simulated, pullbacks = self._simulated(self.phase)
        scaled = self._scaled(simulated, np.maximum(captured, 0))
        predicted = self._learning.error(simulated, scaled)
        if held:
            if self._learning.judge(simulated, scaled):
                self.stopped = "the held-out error rises"
        else:
            self._learning.learn(simulated, scaled)
        psnr = np.array(
            [quality(np.maximum(y, 0), t).psnr_db for y, t in zip(captured, self.target, strict=True)]
        )
        better, worse = psnr > self._best_psnr, psnr < self._best_psnr - WORSE_DB
        self.best_phase[better], self._best_psnr[better] = self.phase[better], psnr[better]
        self._step[worse] /= 2
        moved = self._moved(simulated, scaled, pullbacks)
        self.phase = np.where(worse[:, None, None], self.best_phase, moved).astype(np.float32)
        heldout, drift = self._learning.heldout_error, self._learning.drift
        step = RefinementStep(number, held, float(psnr.mean()), predicted, heldout, drift, self.stopped)
        self.steps.append(step)
        if self.log:
            self.log.write(json.dumps(asdict(step)) + "\n")
            self.log.flush()
        return step

    def _simulated(self, phase: np.ndarray) -> tuple[np.ndarray, list[Pullback]]:
        """Irradiance of mean 1 on the panel's pixels, and functions from a gradient over it to a Gauss-Newton step."""
        light, back = np.zeros_like(self.target), []
        for c, path in enumerate(self.paths):
            image, pullback = irradiance_and_pullback(path, phase[c])
            pixels = pixel_irradiance(path, image)
            light[c] = pixels / pixels.mean()
            back.append(_to_step(path, pullback))
        return light, back

    def _scaled(self, simulated: np.ndarray, captured: np.ndarray) -> np.ndarray:
        """A captured picture, each colour scaled to D of the simulated picture."""
        self._learning.evaluate(simulated, captured)
        return np.stack([matched(y, d) for y, d in zip(captured, self.approximator.corrected, strict=True)])

    def _moved(self, simulated: np.ndarray, scaled: np.ndarray, pullbacks: list[Pullback]) -> np.ndarray:
        """The next pattern: one step down the gradient, with the captured picture instead of the simulated one."""
        self._learning.evaluate(simulated, scaled)
        made = _amplitude(self.approximator.corrected)
        wanted = np.stack([matched(t, y) for t, y in zip(self.target, scaled, strict=True)])
        # The network subtracts a target from its own output: with this target, the camera's residual remains.
        instead = np.maximum(made - _amplitude(scaled) + _amplitude(wanted), 0) ** 2 - EPSILON
        self._learning.evaluate(simulated, np.maximum(instead, 0))
        moved = [
            drive.held(p - np.float32(length) * back(slope.copy()))
            for drive, p, length, back, slope in zip(
                self.drives, self.phase, self._step, pullbacks, self.approximator.slope, strict=True
            )
        ]
        return np.stack(moved)


def refine(refinement: Refinement, show_and_capture: ShowAndCapture, captures: int) -> list[RefinementStep]:
    """Show, capture and learn; at the end the best pattern is shown.

    Parameters
    ----------
    refinement : Refinement
    show_and_capture : callable
        Shows gray levels [C, H, W] and returns the camera's picture of them, irradiance [C, H, W].
    captures : int
        Captures at most.
    """
    for _ in range(captures):
        if refinement.take(show_and_capture(refinement.gray)).stopped:
            break
    else:
        refinement.stopped = "all captures are taken"
    show_and_capture(refinement.gray)
    return refinement.steps


def _to_step(path: LightPath, pullback: Pullback) -> Pullback:
    """From a gradient over pixels of mean irradiance 1 to the step over phase, for a path that loses no light."""
    power = float(np.mean(np.abs(path.source) ** 2))
    return lambda slope: pullback(pixel_irradiance_adjoint(path, slope)) / power


def _amplitude(light: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(light, 0) + EPSILON)


def matched(light: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Light [H, W] scaled so that its amplitude is nearest to that of a reference."""
    root, reference_root = np.sqrt(light), np.sqrt(np.maximum(reference, 0))
    scale = float(np.vdot(root, reference_root)) / max(float(np.vdot(root, root)), 1e-30)
    return light * np.float32(scale**2)
