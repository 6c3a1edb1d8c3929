"""Where the supervisor has a real-time priority, the solver has a lower one: no heartbeat waits for it."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import pytest

from runtime.service.child_processes import ChildProcess
from runtime.service.process_messages import SOLVER
from tests.campaigns.headset import urgent
from tests.campaigns.lane import Lane


@pytest.mark.parametrize(("yields", "lower"), [(True, 1), (False, 0)])
def test_a_child_that_computes_is_scheduled_below_its_supervisor(yields: bool, lower: int) -> None:
    child = ChildProcess("http.server", "0", SOLVER, yields)
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
