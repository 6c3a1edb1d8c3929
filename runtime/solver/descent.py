"""From a first phase to the best one met, by an iteration count or a deadline, for one picture."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from runtime.solver.deadline import Deadline, Paces
from runtime.solver.objective import Objective
from runtime.solver.retrieval_methods import Method

Array = Any
IterationReport = Callable[[int, float], None]


class Descent:
    """A method's steps; where the panel's few levels are in the loop, in stages of ever sharper rounding.

    Parameters
    ----------
    objective : Objective
    method : Method or None
        None: the start alone.

    Attributes
    ----------
    start : float array [C N, H, W], rad
        Where the first phase is put before `run`, after which the array may be another one.
    best : float array [C N, H, W], rad
        The best phase met; it stays until the next `run`, whose start is then put into another array (`next_start`).
    given : tuple of float
        What a target of 1 gets at `best`.
    paces : Paces
        How long the parts took; `rounding` is left to the caller.
    """

    def __init__(self, objective: Objective, method: Method | None) -> None:
        xp, real = objective.backend.xp, objective.light.dtype
        self.objective, self.method = objective, method
        self.start, *self._others = (xp.zeros(objective.shape, real) for _ in range(3))
        self._begun_from: Array = None if objective.rounding is None else xp.zeros(objective.shape, real)
        self.best = self.start
        self.given: tuple[float, ...] = ()
        self.paces = Paces()

    def next_start(self) -> Array:
        """Make `start` an array that does not hold `best`; returns one to work in that is neither."""
        if self.start is self.best:
            self.start, self._others[0] = self._others[0], self.start
        return next(phase for phase in self._others if phase is not self.best)

    def run(
        self,
        begun: float,
        iterations: int,
        deadline_ms: float | None,
        cold: bool,
        progress: IterationReport | None,
    ) -> list[float]:
        """Steps from `start` until the iterations or the time are used up.

        Parameters
        ----------
        begun : float, s
            When the solve began, of which the deadline counts from (time.perf_counter).
        iterations : int
        deadline_ms : float or None, ms
        cold : bool
            Whether the start comes from the targets alone.
        progress : callable or None
            Called with the iterations done and the best PSNR (dB) so far.

        Returns
        -------
        list of float, dB
            PSNR at the start and after each step.
        """
        history: list[float] = []
        rounding = self.objective.rounding
        stages: tuple[float, ...] = (0.0,)
        if rounding is not None:
            self._at_first = self._rounded(self.start)
            self._begun_from[...] = self.start
            stages = rounding.stages if iterations else rounding.stages[-1:]
        for stage, sharpness in enumerate(stages, 1):
            if rounding is not None:
                rounding.sharpness = sharpness
            part = None if deadline_ms is None else deadline_ms * stage / len(stages)
            self._stage(begun, iterations * stage // len(stages), part, cold, history, progress)
        return history

    def settle(self) -> float | None:
        """The PSNR (dB) of the levels that are nearest to `best`, where few levels are in the loop; else None.

        A descent that is cut short, or goes on for long, can end below its start, which is then the best.
        """
        if self.objective.rounding is None:
            return None
        loss, psnr_db, self.given = self._rounded(self.best)
        if loss > self._at_first[0]:
            self.best[...] = self._begun_from
            _, psnr_db, self.given = self._at_first
        return psnr_db

    def _rounded(self, phase: Array) -> tuple[float, float, tuple[float, ...]]:
        """The loss, the PSNR (dB) and what a target of 1 gets, of the panel's levels that are nearest to a phase."""
        assert self.objective.rounding is not None
        self.objective.rounding.sharpness = math.inf
        return self.objective.look(phase), self.objective.psnr_db, self.objective.given

    def _stage(
        self,
        begun: float,
        iterations: int,
        deadline_ms: float | None,
        cold: bool,
        history: list[float],
        progress: IterationReport | None,
    ) -> None:
        """Steps until `history` has a number for the start and for that many, or the time is used up.

        From `start`, or from the best phase of the stage before.
        """
        deadline = Deadline(deadline_ms, self.paces)
        now = self.best = self.best if history else self.start
        if self.method is not None:
            self.method.begin()
        lowest = self.objective.look(now)
        self.given = self.objective.given
        clock = time.perf_counter()
        if not history:
            if cold:
                self.objective.keep_light()
            history.append(self.objective.psnr_db)
            self.paces.start.took(1e3 * (clock - begun))
        while True:
            if progress:
                progress(len(history) - 1, max(history))
            if len(history) > iterations or self.method is None:
                break
            if not deadline.allows_another(1e3 * (clock - begun)):
                if len(history) == 1:
                    self.paces.iteration.skipped()
                break
            following = next(p for p in (self.start, *self._others) if p is not now and p is not self.best)
            self.method.step(now, following)
            now = following
            loss = self.objective.look(now)
            history.append(self.objective.psnr_db)
            if loss < lowest:
                lowest, self.best, self.given = loss, now, self.objective.given
            before, clock = clock, time.perf_counter()
            self.paces.iteration.took(1e3 * (clock - before))
