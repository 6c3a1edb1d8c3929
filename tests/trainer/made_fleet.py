"""Fleets for tests: results whose truth is known, and small capture sets of benches that drift."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import read_captures
from trainer.effects.effect_catalogue import catalogue
from trainer.fleet.set_result import FittedNumber, SetFacts, SetResult
from trainer.model.model import Model, absent, instance_with
from trainer.model.model_file import write_model

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


def set_of_bench(
    folder: Path, headset: str, seed: int, *defects: str, patterns: int = 4, taken: datetime | None = None
) -> Path:
    """A capture set of a simulated headset of 96 x 80 pixels with these defects (TOML lines after [[defect]])."""
    where = folder / f"{headset}-{seed}"
    with TemporaryDirectory() as bench:
        acquire_from(str(bench_file(Path(bench), *defects)), where, patterns=patterns, seed=seed)
    known = where / "bench.toml"
    known.write_text(known.read_text().replace('name = "virtual-bench"', f'name = "{headset}"'))
    if taken is not None:
        column_added(where / "captures.csv", "taken_at", taken.isoformat())
    return where


def column_added(path: Path, name: str, text: str) -> None:
    """Give every row of a captures.csv one text in a further column."""
    first, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{first},{name}", *(f"{row},{text}" for row in rows)]) + "\n")


def defects_of(cause: float, other: float) -> tuple[str, ...]:
    """A distance and a phase's gain that go with one cause, and a leak that goes with another; each -1 to 1."""
    return (
        f'kind = "distance"\noffset_mm = {0.1 + 0.08 * cause:.4f}',
        f'kind = "phase_response"\ngain = {1.06 + 0.03 * cause:.4f}\ns_curvature = 0\nlopsidedness = 0',
        f'kind = "zero_order"\nfill_factor = 1.0\nsurface_amplitude = {0.15 + 0.05 * other:.4f}',
    )


def drifting(count: int, seed: int = 0) -> list[tuple[str, ...]]:
    """Defects of that many headsets, of causes that are spread evenly."""
    rng = np.random.default_rng(seed)
    causes = (rng.permutation(np.linspace(-1, 1, count)) for _ in range(2))
    return [defects_of(cause, other) for cause, other in zip(*causes, strict=True)]


def start_model(path: Path, captures: Path) -> Path:
    """Write a model with these three effects, at values of no headset."""
    bench, known = read_captures(captures).bench, catalogue()
    model = (
        Model(bench).having(absent(known["distance"], bench)).having(absent(known["phase_response"], bench))
    )
    leak = instance_with(known["zero_order"], bench, {"leak_real": 0.05, "leak_imaginary": 0.1})
    write_model(path, model.having(leak))
    return path
