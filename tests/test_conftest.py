"""What every test shares."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CHILD = "import signal; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
PARENT = f"import subprocess, sys; import tests.conftest; subprocess.run([sys.executable, '-c', {CHILD!r}], check=True)"


def ignore_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def test_programs_that_tests_start_act_on_ctrl_c_although_the_suite_runs_in_the_background() -> None:
    line = [sys.executable, "-c", PARENT]
    out = subprocess.run(
        line, cwd=ROOT, preexec_fn=ignore_ctrl_c, capture_output=True, text=True, check=True, timeout=120
    )
    assert out.stdout == "True\n"
