"""The solver's process is ready before its first frame: what it measures of the machine, it measures at its start."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from runtime.service.configuration import read_configuration
from runtime.service.frame_solver import Pattern, PatternSolver
from runtime.service.process_messages import REFINED, SolveJob
from runtime.service.refinement_client import RefinementClient
from runtime.service.shared_memory import crc32, make_ring
from runtime.service.socket_link import MessageLink
from runtime.service.solver_process import Worker
from runtime.solver import Solver
from runtime.solver.array_backend import Backend
from tests.campaigns.headset import SHAPE, write_configuration
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


def test_colours_move_together_and_one_that_was_dark_looks_for_its_motion_itself() -> None:
    """A pan that all colours share, each with a part of the picture's content; green is dark in every fourth frame."""
    shape = (90, 120)
    path = ideal_path(shape, 5e-3, 0.5, np.float32)
    together = PatternSolver({"red": path, "green": path}, grid="panel")
    alone = [PatternSolver({"red": path}, grid="panel") for _ in range(2)]
    content = scene(shape).astype(np.float32)
    pictures = np.stack([content, 0.5 * content[:, ::-1]])
    for n in range(9):
        target = np.roll(pictures, 2 * n, 2)
        if n % 4 == 3:
            target[1] = 0
        found = next(together.patterns(target, time.monotonic_ns()))
        for k in range(2 if target[1].any() else 1):
            one = next(alone[k].patterns(target[k : k + 1], time.monotonic_ns()))
            assert np.mean(found.gray[k] != one.gray[0]) < 1e-3, (n, k)
        assert target[1].any() or not found.gray[1].any()


def test_a_picture_keeps_its_pattern_while_its_refinement_makes_the_first_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A solver that goes on until each deadline would leave a refinement on the same cores no time."""
    refinement = SimpleNamespace(pattern=None, crc=0, alive=True)
    refinement.is_alive, refinement.stop = lambda: refinement.alive, lambda: None
    settings = read_configuration(write_configuration(tmp_path))
    sent: list[Any] = []
    link = SimpleNamespace(send=lambda message, fds=(): sent.append(message))
    worker = Worker(cast(MessageLink, link), (1, *SHAPE), 1, ("green",), settings)
    solved: list[int] = []

    def solve(target: np.ndarray, deadline_ns: int) -> Iterator[Pattern]:
        solved.append(deadline_ns)
        yield Pattern(np.full((1, *SHAPE), len(solved), np.uint8), 20.0, final=True)

    def show(picture: int) -> int:
        """The first gray level of the pattern for a picture."""
        ring.slots[0][...] = picture
        worker.free = set(range(4))
        worker.jobs.append(SolveJob(0, 1, 0, crc32(ring.slots[0])))
        with pytest.raises(ConnectionError):
            worker.run(solve)
        return int(worker.ring.slots[sent[-1].slot][0, 0, 0])

    def closed(wait: bool) -> None:
        if wait:
            raise ConnectionResetError

    ring = make_ring(1, (1, *SHAPE), np.uint16)
    worker.targets, worker.receive = ring, closed  # type: ignore[method-assign]
    assert [show(7), show(7)] == [1, 2]
    worker.refinement = cast(RefinementClient, refinement)
    refinement.crc = crc32(ring.slots[0])
    assert [show(7), show(7)] == [2, 2] and len(solved) == 2
    refinement.pattern = Pattern(np.full((1, *SHAPE), 9, np.uint8), 21.0, final=True)
    assert show(7) == 9 and sent[-1].flags & REFINED
    refinement.pattern, refinement.alive = None, False  # it failed
    assert show(7) == 3
    refinement.alive = True
    assert show(8) == 4 and worker.refinement is None  # another picture
