"""Large temporaries are faulted in once, not at every use."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from runtime.program.large_blocks import keep_large_blocks

ROOT = Path(__file__).resolve().parents[2]
FAULTS = """
import resource, sys
import numpy as np
if sys.argv[1] == "kept":
    from runtime.program.large_blocks import keep_large_blocks
    assert keep_large_blocks()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for k in range(40):
    block = np.ones(48 * 2**20 // 8)
    block = block * 2
    del block
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not keep_large_blocks(), reason="the C library is not glibc")
def test_large_temporaries_are_faulted_in_once() -> None:
    faults = {
        how: int(
            subprocess.run(
                [sys.executable, "-c", FAULTS, how], cwd=ROOT, check=True, capture_output=True
            ).stdout
        )
        for how in ("given_back", "kept")
    }
    assert faults["kept"] < 0.2 * faults["given_back"], faults


HELD = """
import os
from pathlib import Path
import numpy as np
from runtime.program.large_blocks import give_back_blocks, keep_large_blocks
keep_large_blocks()
blocks = [np.ones(2**24) for _ in range(20)]  # 128 MiB each
last = np.ones(2**20)  # below which the C library keeps what is free
del blocks
def held() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**30
before = held()
give_back_blocks()
print(before, held())
"""


@pytest.mark.skipif(not keep_large_blocks(), reason="the C library is not glibc")
def test_a_process_that_waits_gives_back_what_it_does_not_use() -> None:
    run = subprocess.run([sys.executable, "-c", HELD], cwd=ROOT, check=True, capture_output=True, text=True)
    before, after = map(float, run.stdout.split())
    assert before > 2
    assert after < 0.5
