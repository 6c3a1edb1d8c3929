"""Fleets for tests: results whose truth is known, and small capture sets of benches that drift."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.fleet.set_result import FittedNumber, SetFacts, SetResult

START = datetime(2026, 1, 5, 9, tzinfo=UTC)


def fitted(
    effect: str, parameter: str, value: float, error: float = 1e-3, absent: float = 0.0
) -> FittedNumber:
    """A number of an effect, of no channel and term."""
    return FittedNumber(effect, "panel", parameter, None, None, None, value, error, absent, "1")


def result(headset: str, session: int, *numbers: FittedNumber, failed: str | None = None) -> SetResult:
    """The result of one set of a headset, a week after its last one."""
    folder = f"/sets/{headset}-{session}"
    facts = SetFacts(folder, headset, "bench.toml", START + timedelta(weeks=session), "captures.csv", "stamp")
    if failed:
        return SetResult(facts, failed)
    return SetResult(facts, None, None, "complete", 0.5, 2e-4, 0.04, (), numbers, (), "0" * 64, 8, 1.5)


def set_of_bench(folder: Path, headset: str, seed: int, *defects: str, patterns: int = 4) -> Path:
    """A capture set of a simulated headset of 96 x 80 pixels with these defects (TOML lines after [[defect]])."""
    where = folder / f"{headset}-{seed}"
    acquire_from(str(bench_file(folder, *defects)), where, patterns=patterns, seed=seed)
    known = where / "bench.toml"
    known.write_text(known.read_text().replace('name = "virtual-bench"', f'name = "{headset}"'))
    return where


def drifting(count: int, seed: int = 0) -> list[tuple[str, ...]]:
    """Defects of that many headsets: a distance and a phase's gain that go with one cause, and a leak that does not."""
    rng = np.random.default_rng(seed)
    causes = (rng.permutation(np.linspace(-1, 1, count)) for _ in range(2))
    return [
        (
            f'kind = "distance"\noffset_mm = {0.1 + 0.08 * cause:.4f}',
            f'kind = "phase_response"\ngain = {1.06 + 0.03 * cause:.4f}\ns_curvature = 0\nlopsidedness = 0',
            f'kind = "zero_order"\nfill_factor = 1.0\nsurface_amplitude = {0.15 + 0.05 * other:.4f}',
        )
        for cause, other in zip(*causes, strict=True)
    ]
