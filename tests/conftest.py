"""What every test shares: one thread a worker, and the folder of practice data beside the repository."""

from __future__ import annotations

import fcntl
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PARALLEL = "PYTEST_XDIST_WORKER" in os.environ

# A shell's script starts what runs in its background with Ctrl-C ignored, and programs pass that on to those that they
# start; the tests send Ctrl-C to themselves and to programs of theirs, which then act on it as in a terminal.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the programs do

if PARALLEL:  # before NumPy and torch are imported: workers that each take every core slow each other down
    for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

# after the variables: Hypothesis may bring NumPy in
import hypothesis  # noqa: E402

# A deadline measures the neighbours on a busy machine, not the code. A run tries the same examples as the one before;
# `pytest --hypothesis-profile search` looks for others.
hypothesis.settings.register_profile("hololoop", deadline=None, derandomize=True)
hypothesis.settings.register_profile("search", deadline=None)
hypothesis.settings.load_profile("hololoop")


@pytest.fixture(autouse=True)
def _one_torch_thread() -> None:
    """Without importing torch for the tests that do not use it."""
    if PARALLEL and (torch := sys.modules.get("torch")) is not None and torch.get_num_threads() != 1:
        torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder `shared` beside the repository: contracts, practice capture sets, real data."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("there is no folder `shared` beside the repository")
    return folder


@pytest.fixture(scope="module")
def real_time() -> Iterator[None]:
    """No other test that must keep time runs meanwhile: a service, or lasers that go dark after 100 ms of silence.

    A service has real-time priority where that is allowed. Two of them leave two cores no time for more, and one can
    keep another test's heartbeat from a core for too long.
    """
    with (Path(tempfile.gettempdir()) / "hololoop-tests-real-time.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
