"""Where the supervisor has a real-time priority, the solver has a lower one: no heartbeat waits for it."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from runtime.service.child_processes import NICER, ChildProcess, below, in_background
from runtime.service.process_messages import SOLVER
from tests.campaigns.headset import urgent
from tests.campaigns.lane import Lane

pytestmark = pytest.mark.usefixtures("real_time")


@pytest.mark.parametrize(("schedule", "lower"), [(below, 1), (None, 0)])
def test_a_child_that_computes_is_scheduled_below_its_supervisor(
    schedule: Callable[[int], None] | None, lower: int
) -> None:
    child = ChildProcess("http.server", "0", SOLVER, schedule)
    with urgent():
        policy, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
        child.start()
        assert child._process is not None
        pid = child._process.pid
        found = os.sched_getscheduler(pid), os.sched_getparam(pid).sched_priority
    child.stop()
    assert found == (
        policy,
        priority - lower if priority else 0,
    )  # without the right to a priority nothing changes


def test_a_child_in_the_background_has_one_core_and_no_real_time_priority() -> None:
    child = ChildProcess("http.server", "0", SOLVER, in_background)
    with urgent():
        child.start()
        assert child._process is not None
        pid = child._process.pid
        found = os.sched_getscheduler(pid), os.getpriority(os.PRIO_PROCESS, pid), os.sched_getaffinity(pid)
    child.stop()
    assert found == (os.SCHED_BATCH, NICER, {max(os.sched_getaffinity(0))})


def test_a_killed_child_is_waited_for_without_priority_before_the_next_one_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policies = []
    wait = subprocess.Popen.wait

    def noted(process: subprocess.Popen[bytes], *arguments: float) -> int:
        policies.append(os.sched_getscheduler(0))  # of the calling thread
        return wait(process, *arguments)

    monkeypatch.setattr(subprocess.Popen, "wait", noted)
    child = ChildProcess("http.server", "0", SOLVER)
    with urgent():
        child.start()
        first = child._process
        child.stop()
        while not child.due(math.inf):
            time.sleep(0.001)
    assert first is not None and first.returncode == -signal.SIGKILL
    assert policies == [os.SCHED_OTHER]


def test_a_child_that_a_driver_holds_does_not_hold_its_supervisor(monkeypatch: pytest.MonkeyPatch) -> None:
    held = threading.Event()
    monkeypatch.setattr("runtime.service.child_processes._wait_for", lambda process: held.wait())
    child = ChildProcess("http.server", "0", SOLVER)
    child.start()
    process = child._process
    assert process is not None
    child.stop()
    assert not child.due(math.inf)  # two processes would fight over the device
    held.set()
    assert process.wait(10) == -signal.SIGKILL
    assert child._end is not None
    child._end.join()
    assert child.due(math.inf)


def test_the_services_solver_is_below_and_its_camera_is_not(tmp_path: Path) -> None:
    lane = Lane(tmp_path, 0)
    try:
        assert lane.light_up()
        solver, camera, service = (
            os.sched_getparam(pid).sched_priority
            for pid in (lane.child("solver"), lane.child("camera"), lane.service.pid)
        )
        assert camera == service and solver == max(0, service - 1)
        threads = [int(path.name) for path in Path(f"/proc/{lane.child('solver')}/task").iterdir()]
        for thread in threads:
            with suppress(ProcessLookupError):
                assert os.sched_getparam(thread).sched_priority == solver
    finally:
        lane.close()
