"""The pattern whose light through a calibrated path is nearest to a picture, by an iteration count or a deadline.

    solver = Solver(path)
    solution = solver.solve(target, deadline_ms=50)
    panel.show(solution.gray)

A solver is prepared once for a light path and then solves picture after picture without allocating anything
large. Its first pattern comes from double phase, whose smooth image phase keeps speckle away; the default
method then takes memoryless BFGS steps of two passes each. The best pattern met is the one returned, so more
time never gives a worse one, up to the rounding to gray levels.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from firmware_iface.errors import InputError, nearest
from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import Approximator, predistorted
from runtime.solver.array_backend import Backend, backend
from runtime.solver.drive_range import DriveRange
from runtime.solver.initialiser import Initialiser
from runtime.solver.method import METHODS, Method
from runtime.solver.objective import Objective, needs_fine_grid
from runtime.solver.pace import Pace
from runtime.solver.penalty import PENALTIES
from runtime.solver.quality import Quality, quality, shown
from runtime.solver.solution import Solution
from runtime.solver.start import Start, is_cut, motion_between, renewed, shifted

Progress = Callable[[int, float], None]
GRIDS = ("panel", "fine")
WAYS = ("gradient", "predistorted")
ITERATIONS = 20
_ENDLESS = 1 << 30


class Solver:
    """Solves for one light path, for several colours (a list of them) or for stacks of planes (a list of lists).

    levels: gray levels that may be used. method, penalty: by name; options: of the method. grid: "panel"
    computes irradiance once a pixel, "fine" twice an axis, about four times the work, which pays where the iris
    passes more than three quarters of the panel's band and there is time; none: by that rule. region: [H, W],
    which pixels count, or how much; light is free to go to the others. approximator: D, a plane a colour.
    through: "gradient" sees through D at each iteration, "predistorted" gives the optics a target that D makes
    right. initialiser: a network in ONNX from a target's amplitude to a first phase. Raises InputError for names
    that are not there and for paths that do not fit together.
    """

    def __init__(
        self,
        paths: LightPath | Sequence[LightPath] | Sequence[Sequence[LightPath]],
        levels: int = 256,
        *,
        method: str = "default",
        penalty: str = "amplitude",
        grid: str | None = None,
        region: np.ndarray | None = None,
        approximator: Approximator | None = None,
        through: str = "predistorted",
        initialiser: bytes | None = None,
        on: Backend | None = None,
        **options: Any,
    ) -> None:
        for what, name, known in (
            ("solver", method, METHODS),
            ("penalty", penalty, PENALTIES),
            ("grid", grid or "fine", GRIDS),
            ("way through the approximator", through, WAYS),
        ):
            if name not in known:
                raise InputError(f"there is no {what} '{name}': {nearest(name, known)}")
        self.stacks = _stacks(paths)
        self.shape = self.stacks[0][0].grid.shape
        self.drives = [DriveRange(stack[0], levels) for stack in self.stacks]
        if approximator is not None and (
            len(self.stacks[0]) > 1 or approximator.shape != (len(self.stacks), *self.shape)
        ):
            raise InputError(
                f"the approximator sees {' x '.join(map(str, approximator.shape))} (colours, height, width) in one "
                f"plane, and there are {len(self.stacks)} colours of {self.shape[0]} x {self.shape[1]} in "
                f"{len(self.stacks[0])} planes: export it for these"
            )
        self.approximator, self.through = approximator, through
        self.region = _checked_region(region, self.shape)
        self.on = on or backend()
        fine = needs_fine_grid(self.stacks) if grid is None else grid == "fine"
        seen_through = approximator if through == "gradient" else None
        self.objective = Objective(self.stacks, 2 if fine else 1, penalty, self.region, seen_through, self.on)
        self.starts = [
            Start(self.objective, stack[0], c, drive.gapless and initialiser is None)
            for c, (stack, drive) in enumerate(zip(self.stacks, self.drives, strict=True))
        ]
        made = METHODS[method]
        self.method: Method | None = made(self.objective, self.drives, **options) if made else None
        if method == "gerchberg_saxton" and (penalty != "amplitude" or seen_through):
            raise InputError(
                "gerchberg_saxton constrains amplitude: use penalty amplitude, predistorted targets"
            )
        self.initialiser = None if initialiser is None else Initialiser(initialiser, self.shape)
        xp, real = self.on.xp, self.stacks[0][0].response.dtype
        whole = (len(self.stacks), *self.shape)
        self.phases = [xp.zeros(whole, real) for _ in range(3)]
        self.grays = [np.zeros(whole, np.uint8) for _ in range(2)]
        self.amplitude = np.zeros(self.shape, real)
        self.before = np.zeros(self.shape, real)
        self.solved = 0
        self.follows = False  # whether `best` is of the picture in `before`
        self.best = self.phases[0]
        self.begin, self.step, self.finish = Pace(), Pace(), Pace()

    def solve(
        self,
        target: np.ndarray,
        iterations: int | None = None,
        *,
        deadline_ms: float | None = None,
        start: np.ndarray | None = None,
        progress: Progress | None = None,
    ) -> Solution:
        """The best pattern met in `iterations` (20 where nothing is said), or by a deadline, or whichever is first.

        target: irradiance [H, W] of any scale, or a colour each [C, H, W], or a plane each too [C, K, H, W] ([K, H, W]
        for one colour). start: phase (rad) to begin from; none: double phase. progress: called with the
        iterations done and the best PSNR so far. The start is always made, also past the deadline. The first
        solve with a deadline measures this machine beforehand. Raises InputError for a target of another size,
        with negative or non-finite values or all dark, and for counts that are out of range.
        """
        targets = self._checked(target)
        _check_budget(iterations, deadline_ms)
        if deadline_ms is not None and not self.step.known:
            self.rehearse(targets)
        begun = time.perf_counter()
        phase = self.phases[0]
        optics_targets = self._aim(targets)
        if start is None:
            self._cold(optics_targets, phase)
        else:
            phase[...] = self.on.xp.asarray(np.reshape(start, phase.shape))
        return self._improve(targets, begun, iterations, deadline_ms, progress)

    def frame(
        self,
        target: np.ndarray,
        iterations: int | None = None,
        *,
        deadline_ms: float | None = None,
        motion: tuple[int, int] | None = None,
    ) -> Solution:
        """`solve` for the next frame of a video, beginning with the pattern of the picture solved before.

        motion: how far content has moved since, (down, right) in pixels; none: found from the frames. The first
        frame and a new scene begin cold. One iteration is usually enough.
        """
        targets = self._checked(target)
        _check_budget(iterations, deadline_ms)
        if deadline_ms is not None and not self.step.known:
            self.rehearse(targets)
        begun = time.perf_counter()
        picture = targets[0, 0]
        if self.follows and motion is None:
            motion = motion_between(self.before, picture)
        warm = self.follows and motion is not None and not is_cut(self.before, picture, motion)
        optics_targets = self._aim(targets)
        if warm and motion is not None:
            first = next(k for k, phase in enumerate(self.phases) if phase is not self.best)
            shifted(self.best, motion, self.phases[first])
            self.phases[0], self.phases[first] = self.phases[first], self.phases[0]
            if any(motion):
                other = next(phase for phase in self.phases if phase is not self.phases[0])
                self._cold(optics_targets, other)
                for phase, fresh, start in zip(self.phases[0], other, self.starts, strict=True):
                    for part in renewed(motion, start.edges, self.shape):
                        phase[part] = fresh[part]
        else:
            self._cold(optics_targets, self.phases[0])
        return self._improve(targets, begun, iterations, deadline_ms, None)

    def rehearse(self, target: np.ndarray | None = None) -> None:
        """Measure how long the start, an iteration and the rounding take on this machine."""
        targets = self._checked(np.ones(self.shape) if target is None else target)
        before, best, follows = self.before.copy(), self.best.copy(), self.follows
        for _ in range(2):  # the first touches memory for the first time and is not counted
            self.begin, self.step, self.finish = Pace(), Pace(), Pace()
            begun = time.perf_counter()
            self._cold(self._aim(targets), self.phases[0])
            self._improve(targets, begun, 3, None, None)
        self.before, self.best[...], self.follows = before, best, follows

    def _improve(
        self,
        targets: np.ndarray,
        begun: float,
        iterations: int | None,
        deadline_ms: float | None,
        progress: Progress | None,
    ) -> Solution:
        """Steps from phases[0] until the budget is used up, and the solution from the best phase met."""
        self.before[...] = targets[0, 0]
        self.follows = True
        if iterations is None:
            iterations = ITERATIONS if deadline_ms is None else _ENDLESS
        if self.method is None:
            iterations = 0
        else:
            self.method.begin()
        now, self.best = self.phases[0], self.phases[0]
        lowest = self.objective.look(now)
        history = [self.objective.psnr_db]
        clock = time.perf_counter()
        self.begin.took(1e3 * (clock - begun))
        while True:
            if progress:
                progress(len(history) - 1, max(history))
            spent = 1e3 * (clock - begun)
            if len(history) > iterations or self.method is None:
                break
            if deadline_ms is not None and spent + self.step.expected + self.finish.expected > deadline_ms:
                break
            following = next(p for p in self.phases if p is not now and p is not self.best)
            self.method.step(now, following)
            now = following
            loss = self.objective.look(now)
            history.append(self.objective.psnr_db)
            if loss < lowest:
                lowest, self.best = loss, now
            before, clock = clock, time.perf_counter()
            self.step.took(1e3 * (clock - before))
        self.grays.reverse()
        for drive, phase, gray in zip(self.drives, self.best, self.grays[0], strict=True):
            drive.gray(self.on.to_host(phase), gray)
        done = time.perf_counter()
        self.finish.took(1e3 * (done - clock))
        gray, phase = self.grays[0], self.on.to_host(self.best)
        if len(gray) == 1:
            gray, phase = gray[0], phase[0]
        self.solved += 1
        judge = partial(self._judged, self.grays[0], targets, self.solved)
        return Solution(gray, phase, tuple(history), 1e3 * (done - begun), judge)

    def _aim(self, targets: np.ndarray) -> np.ndarray:
        """Point the objective at targets; returns those that the optics should show."""
        shown_by_optics = targets
        if self.approximator is not None:
            shown_by_optics = predistorted(self.approximator, targets)
        self.objective.aim(shown_by_optics if self.through == "predistorted" else targets)
        return shown_by_optics

    def _cold(self, targets: np.ndarray, phases: Any) -> None:
        for c, (drive, start, phase) in enumerate(zip(self.drives, self.starts, phases, strict=True)):
            np.multiply(
                targets[c, 0], 1 / float(np.mean(targets[c, 0], dtype=np.float64)), out=self.amplitude
            )
            np.sqrt(self.amplitude, out=self.amplitude)
            if self.initialiser is not None:
                phase[...] = self.on.xp.asarray(self.initialiser.phase(self.amplitude))
            elif drive.gapless:
                start.double_phase(self.amplitude, phase)
            else:
                start.flat_phase(self.amplitude, phase)
            if drive.bounded:
                phase[...] = self.on.xp.asarray(drive.held(self.on.to_host(phase)))

    def _judged(self, patterns: np.ndarray, targets: np.ndarray, number: int) -> tuple[Quality, ...]:
        if self.solved > number + 1:
            raise InputError(
                "the pattern has been written again: ask for its quality before the second next solve"
            )
        light = np.stack(
            [[shown(p, gray) for p in stack] for stack, gray in zip(self.stacks, patterns, strict=True)]
        )
        d = self.approximator
        if d is not None:
            for c in range(len(light)):
                d.irradiance[c] = light[c, 0] / light[c, 0].mean()
            d.correct()
            light[:, 0] = d.corrected
        region = None if self.region is None else self.region > 0
        whole = zip(light.reshape(-1, *self.shape), targets.reshape(-1, *self.shape), strict=True)
        return tuple(quality(seen, wanted, region) for seen, wanted in whole)

    def _checked(self, target: np.ndarray) -> np.ndarray:
        """A target as [C, K, H, W], without copying what is right. Raises InputError."""
        target = np.asarray(target)
        colours, planes = len(self.stacks), len(self.stacks[0])
        if target.shape[-2:] != self.shape or target.ndim < 2:
            raise InputError(
                f"the target is {' x '.join(map(str, target.shape))} (height x width) and the panel "
                f"{self.shape[0]} x {self.shape[1]}: resize or fit the picture"
            )
        leading = target.shape[:-2]
        if leading == (colours,) and colours > 1:
            target = target[:, None]
        elif leading not in ((), (planes,) if colours == 1 else (), (colours, planes)):
            raise InputError(
                f"the target is {' x '.join(map(str, target.shape))}; for {colours} colours and {planes} planes "
                f"give {colours} x {planes} x {self.shape[0]} x {self.shape[1]}, or one picture for all"
            )
        low, high = float(target.min()), float(target.max())
        if not (math.isfinite(low) and math.isfinite(high)) or low < 0:
            raise InputError("the target has negative or non-finite values: irradiance is never below zero")
        whole = np.broadcast_to(target, (colours, planes, *self.shape))
        if not all(one.max() > 0 for one in whole.reshape(-1, *self.shape)):
            raise InputError(
                "the target is all dark: any pattern shows some light, so give it a bright pixel"
            )
        return whole


def solve(
    path: LightPath,
    target: np.ndarray,
    iterations: int | None = None,
    levels: int = 256,
    start: np.ndarray | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Solution:
    """One picture through one path: `Solver(path, levels, **options).solve(target, iterations, ...)`.

    deadline_ms may be among the options.
    """
    deadline_ms = options.pop("deadline_ms", None)
    solver = Solver(path, levels, **options)
    return solver.solve(target, iterations, deadline_ms=deadline_ms, start=start, progress=progress)


def _stacks(paths: Any) -> list[list[LightPath]]:
    """Colours of planes. Raises InputError where their panels differ or planes are not the same number."""
    listed = [paths] if isinstance(paths, LightPath) else list(paths)
    stacks = [[one] if isinstance(one, LightPath) else list(one) for one in listed]
    if not stacks or not all(stacks):
        raise InputError("there is no light path to solve for: give one, or a list of them")
    first = stacks[0][0].grid.shape
    if any(len(stack) != len(stacks[0]) for stack in stacks):
        raise InputError("the colours have different numbers of planes: give each the same")
    for path in (p for stack in stacks for p in stack):
        if path.grid.shape != first:
            raise InputError(
                f"the light paths have panels of {path.grid.shape} and {first}: give one panel's"
            )
    return stacks


def _checked_region(region: np.ndarray | None, shape: tuple[int, int]) -> np.ndarray | None:
    if region is None:
        return None
    region = np.asarray(region, float)
    if region.shape != shape or not np.isfinite(region).all() or region.min() < 0 or not region.max() > 0:
        raise InputError(
            f"the region must be {shape[0]} x {shape[1]} weights, none below zero and not all zero"
        )
    return region


def _check_budget(iterations: int | None, deadline_ms: float | None) -> None:
    if iterations is not None and iterations < 0:
        raise InputError(f"{iterations} iterations: give 0 (the start alone) or more")
    if deadline_ms is not None and not (math.isfinite(deadline_ms) and deadline_ms > 0):
        raise InputError(f"a deadline of {deadline_ms} ms: give milliseconds above 0")
