"""The solver's process is ready before its first frame: what it measures of the machine, it measures at its start."""

from __future__ import annotations

import time

import numpy as np
import pytest

from runtime.service.frame_solver import PatternSolver
from runtime.solver import Solver
from runtime.solver.array_backend import Backend
from tests.campaigns.headset import SHAPE
from tests.runtime.benches import ideal_path, scene


@pytest.mark.parametrize("rehearsed", [True, False])
def test_no_frame_waits_until_the_machine_is_measured(
    rehearsed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a panel of 1080 x 1920 that takes seconds, and a solver so silent counts as hung."""
    solver = PatternSolver({name: ideal_path(SHAPE, 6e-3, 1.0, np.float32) for name in ("red", "green")})
    if rehearsed:
        solver.rehearse()
    measured = []
    rehearse = Solver.rehearse
    monkeypatch.setattr(Solver, "rehearse", lambda *given: measured.append(given) or rehearse(*given))
    target = np.broadcast_to(scene(SHAPE) / scene(SHAPE).max(), solver.shape).astype(np.float32)
    made = list(solver.patterns(target, time.monotonic_ns() + 1_000_000_000))
    assert [pattern.final for pattern in made] == [False, True]
    assert len(measured) == (0 if rehearsed else 2)


def test_colours_that_are_computed_at_the_same_time_do_not_disturb_each_other() -> None:
    shape = (90, 120)
    paths = {f"{mm} mm": ideal_path(shape, 1e-3 * mm, 0.6, np.float32) for mm in (4, 7, 11)}
    solvers = [PatternSolver(paths, grid="panel", on=Backend(cores)) for cores in (1, 2)]
    pictures = scene(shape) * np.array([1.0, 0.5, 0.2], np.float32)[:, None, None]
    for pixels in range(0, 12, 2):
        target = np.roll(pictures, pixels, 2)
        one, several = (next(solver.patterns(target, time.monotonic_ns())) for solver in solvers)
        assert np.mean(one.gray != several.gray) < 1e-3  # sums over rows differ in their last digits
        assert one.psnr_db == pytest.approx(several.psnr_db, abs=1e-3)
