"""A capture set that is larger than memory should have to be: 60 captures of 1080 x 1920. Run with -m slow."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trainer.captures.capture_writer import CaptureWriter
from trainer.effects.testing import small_bench

GIB = 2**30


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random patterns, and pictures of random speckle.

    They fit no pattern at any distance, so that `check` and the commands that check first search all distances.
    """
    folder = tmp_path_factory.mktemp("large") / "captures"
    bench = replace(small_bench(1080, 1920), distance_mm=100.0)
    rng = np.random.default_rng(0)
    with CaptureWriter(folder, bench) as writer:
        for number in range(60):
            gray = rng.integers(0, 256, bench.panel.shape, dtype=np.uint8)
            speckle = rng.exponential(400, bench.camera.shape) + bench.camera.black_level
            raw = np.clip(speckle, 0, bench.camera.saturation).astype(np.uint16)
            writer.add(gray, raw, "green", pattern=f"{number:03d}")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("command", "exit_code"), [("check", 1), ("compare", 0), ("add zero_order", 0)])
def test_sixty_large_captures_need_less_than_six_gib(
    command: str, exit_code: int, large: Path, tmp_path: Path
) -> None:
    words = [*command.split(), str(large), "--json"]
    if words[0] == "add":
        words += ["--out", str(tmp_path / "model.toml")]
    script = (
        "import resource, sys; from trainer.cli import main\n"
        f"code = main({words!r})\n"
        "print(code, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=3000)
    code, kilobytes = map(int, done.stderr.splitlines()[-1].split())
    print(f"{command}: {kilobytes * 1024 / GIB:.2f} GiB")
    assert code == exit_code, done.stderr
    assert kilobytes * 1024 < 6 * GIB
