"""Threads that wait leave the cores to others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")
ROOT = Path(__file__).resolve().parents[2]
CORES = 2
# In a single round, threads may happen to run side by side, or always to wake each other on another core.
ROUNDS = 3
BUSY = "while True: pass"
# Small steps with a barrier after each, as a fit has: as many as are done within 0.6 seconds of processor time.
STEPS = """
import os, sys, time
if sys.argv[1] == "asleep":
    from runtime.program.threads import share_cores
    share_cores()
import torch
torch.set_num_threads(2)
a = torch.ones(300_000)
for _ in range(50):
    a = a * 1.0001
begin, steps = time.process_time(), 0
while time.process_time() - begin < 0.6:
    a = a * 1.0001
    steps += 1
print(steps)
"""
# How many threads this process has after a transform and a pass over rows that several could share.
SHARED_WORK = """
import os
import numpy as np
from runtime.lightpath import fft
from runtime.solver.array_backend import Backend
fft.fft(np.ones((1024, 1024), np.complex64), 0)
Backend().over_rows(1024, 64, lambda worker, rows: None)
print(len(os.listdir("/proc/self/task")))
"""
# The same after a product of matrices in a program that shares the cores.
PRODUCT = """
import os
from runtime.program.threads import share_cores
share_cores()
import numpy as np
import scipy.linalg
table = np.ones((48, 100_000))
scipy.linalg.solve(table @ table.T + np.eye(48), table[:, 0])
print(len(os.listdir("/proc/self/task")))
"""
OF_THREADS = ("OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_")


def environment_without_threads() -> dict[str, str]:
    """This process's environment without what it says of threads."""
    return {k: v for k, v in os.environ.items() if not k.startswith(OF_THREADS)}


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads cannot be counted here")
def test_products_of_a_program_take_one_thread() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PRODUCT],
        cwd=ROOT,
        env=environment_without_threads(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout) == 1


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads cannot be counted here")
def test_the_solver_uses_no_more_threads_than_the_process_was_given() -> None:
    limited = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", SHARED_WORK],
        cwd=ROOT,
        env={**os.environ, **limited},
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout) == 1


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be put on two cores here")
def test_on_busy_cores_waiting_threads_leave_the_time_to_those_that_work() -> None:
    cores = sorted(os.sched_getaffinity(0))[:CORES]

    def begun(*arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", *arguments],
            cwd=ROOT,
            env=environment_without_threads(),
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: os.sched_setaffinity(0, cores),
        )

    neighbours = [begun(BUSY) for _ in range(CORES)]
    try:
        steps = {"spinning": 0, "asleep": 0}
        for _ in range(ROUNDS):
            # At the same time, so that other work on this machine slows both.
            measured = {how: begun(STEPS, how) for how in steps}
            for how, one in measured.items():
                steps[how] += int(one.communicate(timeout=240)[0])
    finally:
        for one in neighbours:
            one.kill()
            one.communicate()
    assert steps["asleep"] > 1.3 * steps["spinning"], steps
