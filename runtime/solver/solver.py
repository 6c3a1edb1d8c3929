"""The pattern whose light through a calibrated path is nearest to a picture, by an iteration count or a deadline.

    solver = Solver(path)
    solution = solver.solve(target, deadline_ms=50)
    panel.show(solution.gray)

A solver is prepared once for a light path and then solves picture after picture without allocating anything
large. Its first pattern comes from double phase, whose smooth image phase keeps speckle away; the usual
method then takes memoryless BFGS steps of two passes each. The best pattern met is the one returned, so more
time never gives a worse one, up to the rounding to gray levels.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from firmware_iface.errors import InputError, nearest
from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import Approximator, predistorted
from runtime.solver.array_backend import Backend
from runtime.solver.block_motion import Change, change_between
from runtime.solver.chosen_backend import backend
from runtime.solver.deadline import Paces, check_deadline
from runtime.solver.descent import Descent, IterationReport
from runtime.solver.drive_range import DriveRange
from runtime.solver.first_phases import FirstPhases
from runtime.solver.objective import Objective, needs_fine_grid
from runtime.solver.penalty import PENALTIES
from runtime.solver.quality import Quality, qualities_of
from runtime.solver.retrieval_methods import DESCENTS, METHODS, OLDER_NAMES, Method
from runtime.solver.soft_levels import SoftLevels, stages_of
from runtime.solver.solution import Solution
from runtime.solver.solver_input import (
    check_approximator,
    check_frames,
    check_iterations,
    checked_region,
    checked_target,
    stacked,
)

GRIDS = ("panel", "fine")
WAYS = ("gradient", "predistorted")
ITERATIONS = 20
COMPARED = 8  # every so many pixels, an axis, tell whether a picture is another one
_ENDLESS = 1 << 30


class Solver:
    """Solves for one light path, for several colours (a list of them) or for stacks of planes (a list of lists).

    Parameters
    ----------
    paths : LightPath, or list of them, or list of lists of them
    levels : int
        Gray levels that may be used.
    method : str
        One of METHODS: "bfgs" (also by its older name "default"), "adam", "gerchberg_saxton" or "double_phase".
    penalty : str
        One of PENALTIES.
    grid : str or None
        "panel" computes irradiance once a pixel. "fine" computes it on the paths' own grids, twice an axis (four times
        behind a wide iris), for about four times the work; that is worth it where the iris passes more than three
        quarters of the panel's band and there is time, and for several frames, which come nearer to the picture. None
        decides by these.
    region : array [H, W] or None
        Which pixels count, or how much; light is free to go to the others.
    approximator : Approximator or None
        The aberration approximator D, a plane a colour.
    through : str
        "gradient" takes D into each iteration; "predistorted" gives the optics a target that D makes right.
    initialiser : bytes or None
        A network in ONNX from a target's amplitude to a first phase.
    frames : int
        Patterns for each colour of a picture, shown in quick turn: their irradiances add in the eye. They are solved
        for together; where the panel has few levels, these are in the loop.
    on : Backend or None
        Where the arrays are; None: the machine's own.
    **options
        Of the method.

    Raises
    ------
    InputError
        For names that do not exist, and for paths that do not fit together.
    """

    def __init__(
        self,
        paths: LightPath | Sequence[LightPath] | Sequence[Sequence[LightPath]],
        levels: int = 256,
        *,
        method: str = "bfgs",
        penalty: str = "amplitude",
        grid: str | None = None,
        region: np.ndarray | None = None,
        approximator: Approximator | None = None,
        through: str = "predistorted",
        initialiser: bytes | None = None,
        frames: int = 1,
        on: Backend | None = None,
        **options: Any,
    ) -> None:
        method = OLDER_NAMES.get(method, method)
        for what, name, known in (
            ("solver", method, METHODS),
            ("penalty", penalty, PENALTIES),
            ("grid", grid or "fine", GRIDS),
            ("way through the approximator", through, WAYS),
        ):
            if name not in known:
                raise InputError(f"there is no {what} '{name}': {nearest(name, known)}")
        self.stacks = stacked(paths)
        self.shape = self.stacks[0][0].grid.shape
        self.frames = check_frames(frames, method)
        if approximator is not None:
            check_approximator(approximator.shape, self.stacks)
        self.approximator, self.through = approximator, through
        self.region = checked_region(region, self.shape)
        self.on = on or backend()
        self.drives = [DriveRange(stack[0], levels, self.on) for stack in self.stacks for _ in range(frames)]
        fine = frames > 1 or needs_fine_grid(self.stacks) if grid is None else grid == "fine"
        in_the_loop = approximator if through == "gradient" else None
        self.objective = Objective(self.stacks, fine, penalty, self.region, in_the_loop, self.on, frames)
        stages = stages_of(self.drives, frames) if method in DESCENTS else ()
        if stages:
            on, objective = self.on, self.objective
            objective.rounding = SoftLevels(self.drives, objective.shape, objective.strip, on, stages)
        self.first = FirstPhases(self.objective, self.stacks, self.drives, initialiser, self.region is None)
        made = METHODS[method]
        self.method: Method | None = made(self.objective, self.drives, **options) if made else None
        if method == "gerchberg_saxton" and (penalty != "amplitude" or in_the_loop):
            raise InputError(
                "gerchberg_saxton constrains amplitude: use penalty amplitude, predistorted targets"
            )
        xp, real = self.on.xp, self.stacks[0][0].response.dtype
        whole = self.objective.shape
        self.descent = Descent(self.objective, self.method)
        self.grays = [xp.zeros(whole, np.uint8) for _ in range(2)]
        self.before = xp.zeros(self.shape, real)
        self.solved = 0
        self.follows = False  # whether the descent's best phase is of the picture in `before`

    def solve(
        self,
        target: np.ndarray,
        iterations: int | None = None,
        *,
        deadline_ms: float | None = None,
        start: np.ndarray | None = None,
        progress: IterationReport | None = None,
    ) -> Solution:
        """The best pattern met in a number of iterations, or by a deadline, whichever is first.

        The start is always made, also past the deadline. The first solve with a deadline measures this machine
        beforehand.

        Of several frames, the solution's arrays have them behind the colours: [N, H, W] or [C, N, H, W].

        Parameters
        ----------
        target : array [H, W], or a colour each [C, H, W], or a plane each too [C, K, H, W] ([K, H, W] for one colour)
            Irradiance of any scale.
        iterations : int or None
            None: 20, or as many as the deadline allows.
        deadline_ms : float or None, ms
            From the target to the gray levels.
        start : float array [H, W] or [C, H, W], or None, rad
            Phase to begin from, of each frame; None: double phase.
        progress : callable or None
            Called with the iterations done and the best PSNR (dB) so far.

        Raises
        ------
        InputError
            For a target of another size, with negative or non-finite values or all dark, and for counts that are
            out of range.
        """
        targets, begun = self._begun(target, iterations, deadline_ms)
        optics_targets = self._aim(targets)
        if start is None:
            self.first.cold(optics_targets, self.descent.start)
        else:
            self.descent.start[...] = self.on.xp.asarray(np.reshape(start, self.objective.shape))
            self.first.tilt(moves=False)
            self.first.fits = self.first.fits and self._is_still(targets)
        return self._improve(targets, begun, iterations, deadline_ms, start is None, progress)

    def frame(
        self,
        target: np.ndarray,
        iterations: int | None = None,
        *,
        deadline_ms: float | None = None,
        motion: tuple[int, int] | None = None,
        change: Change | None = None,
    ) -> Solution:
        """`solve` for the next frame of a video, beginning with the pattern of the picture solved before.

        The first frame and a new scene begin cold. One iteration is usually enough.

        Parameters
        ----------
        target, iterations, deadline_ms
            As in `solve`.
        motion : (int, int) or None, pixels
            How far content has moved since as a whole: down, right. None: found from the frames. What moves by itself
            is found.
        change : Change or None
            All that has become of the picture before, where it is known: of one that has other colours, too.
        """
        targets, begun = self._begun(target, iterations, deadline_ms)
        if not self.follows:
            change = None
        elif change is None:
            change = change_between(self.before, _grayscale(targets), self.on, motion)
        optics_targets = self._aim(targets)
        if change is None or change.cut:
            cold = True
            self.first.cold(optics_targets, self.descent.start, soon=True)
        else:
            cold = False
            descent, still = self.descent, self._is_still(targets)
            room = descent.next_start()
            self.first.warm(
                descent.best, change.motion, change.parts, optics_targets, descent.start, room, still
            )
        return self._improve(targets, begun, iterations, deadline_ms, cold, None)

    def rehearse(self, target: np.ndarray | None = None) -> Solution:
        """Measure how long the start, an iteration and the rounding take here, on a white picture or another.

        What `frame` goes on from stays as it is.
        """
        targets = self._checked(np.ones(self.shape) if target is None else target)
        before, best, follows = self.before.copy(), self.descent.best.copy(), self.follows
        least, moves = list(self.objective.least), self.first.moves
        for _ in range(2):  # the first touches memory for the first time and is not counted
            self.descent.paces = Paces()
            begun = time.perf_counter()
            self.first.cold(self._aim(targets), self.descent.start)
            solution = self._improve(targets, begun, 3, None, True, None)
        self.before, self.descent.best[...], self.follows = before, best, follows
        self.objective.least = least
        self.first.tilt(moves)
        self.first.fits = False
        return solution

    def _begun(
        self, target: np.ndarray, iterations: int | None, deadline_ms: float | None
    ) -> tuple[Any, float]:
        """The checked targets, where the solver computes, and the time (s) that a deadline counts from."""
        targets = self._checked(target)
        check_iterations(iterations)
        check_deadline(deadline_ms)
        if deadline_ms is not None and not self.descent.paces.iteration.known:
            self.rehearse(targets)
        return targets, time.perf_counter()

    def _improve(
        self,
        targets: Any,
        begun: float,
        iterations: int | None,
        deadline_ms: float | None,
        cold: bool,
        progress: IterationReport | None,
    ) -> Solution:
        """Steps from the descent's start until the iterations or the time are used up; of the best phase met."""
        self.before[...] = _grayscale(targets)
        self.follows = True
        if iterations is None:
            iterations = ITERATIONS if deadline_ms is None else _ENDLESS
        descent = self.descent
        history = descent.run(begun, iterations, deadline_ms, cold, progress)
        clock = time.perf_counter()
        settled = descent.settle()
        best = descent.best
        self.grays.reverse()
        for drive, phase, gray in zip(self.drives, best, self.grays[0], strict=True):
            drive.gray(phase, gray)
        gray = self.on.to_host(self.grays[0])
        done = time.perf_counter()
        descent.paces.rounding.took(1e3 * (done - clock))
        shape = *(n for n in (len(self.stacks), self.frames) if n > 1), *self.shape
        self.solved += 1
        return Solution(
            gray.reshape(shape),
            tuple(history),
            max(history) if settled is None else settled,
            1e3 * (done - begun),
            descent.given,
            lambda: self.on.to_host(best).reshape(shape),
            partial(self._judged, gray, targets, self.solved),
        )

    def _aim(self, targets: Any) -> Any:
        """Point the objective at targets; returns those that the optics should show."""
        shown_by_optics = targets
        if self.approximator is not None:
            wanted = predistorted(self.approximator, self.on.to_host(targets))
            shown_by_optics = self.on.xp.asarray(wanted)
        self.objective.aim(targets if self.through == "gradient" else shown_by_optics)
        return shown_by_optics

    def _is_still(self, targets: Any) -> bool:
        """Whether targets [C, K, H, W] are of the picture solved before, judged by some of its pixels."""
        some = (slice(None, None, COMPARED), slice(None, None, COMPARED))
        return bool(self.on.xp.array_equal(_grayscale(targets[..., *some]), self.before[some]))

    def _judged(self, patterns: np.ndarray, targets: Any, number: int) -> tuple[Quality, ...]:
        if self.solved > number + 1:
            raise InputError(
                "the pattern has been written again: ask for its quality before the second next solve"
            )
        grays = patterns.reshape(len(self.stacks), self.frames, *self.shape)
        return qualities_of(self.stacks, grays, self.on.to_host(targets), self.region, self.approximator)

    def _checked(self, target: np.ndarray) -> Any:
        there = self.on.xp.asarray(target)
        return checked_target(there, len(self.stacks), len(self.stacks[0]), self.shape, self.on)


def _grayscale(targets: Any) -> Any:
    """The picture [H, W] whose motion is looked for: the mean of its colours, one of which may be dark."""
    return targets[0, 0] if len(targets) == 1 else targets[:, 0].mean(0)


def solve(
    path: LightPath,
    target: np.ndarray,
    iterations: int | None = None,
    levels: int = 256,
    start: np.ndarray | None = None,
    progress: IterationReport | None = None,
    **options: Any,
) -> Solution:
    """One picture through one path: `Solver(path, levels, **options).solve(target, iterations, ...)`.

    deadline_ms may be among the options.
    """
    deadline_ms = options.pop("deadline_ms", None)
    solver = Solver(path, levels, **options)
    return solver.solve(target, iterations, deadline_ms=deadline_ms, start=start, progress=progress)
