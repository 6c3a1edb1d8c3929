"""How many processes a command takes by default: one a core, or as many as memory is there for."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import pytest
import torch

from tests.trainer.made_sets import bench_tables, make_set
from trainer.captures.bench_file import read_bench
from trainer.commands.workers import workers_of
from trainer.fitting import process_memory
from trainer.fitting.process_memory import process_bytes

GB = 10**9


def args(folder: Path, count: int | None = None) -> Namespace:
    return Namespace(captures=folder, workers=count, cluster=None, device="cpu")


def test_a_process_of_a_full_size_bench_takes_what_was_measured() -> None:
    tables = bench_tables((1200, 1920)) | {"propagation": {"distance_mm": 200}}
    tables["channel"] = [{"name": "infrared", "wavelength_nm": 780}]
    assert process_bytes(read_bench(tables)) == pytest.approx(7 * GB, rel=0.1)
    assert process_bytes(read_bench(bench_tables((240, 320)))) < 0.6 * GB


@pytest.mark.parametrize(("free", "expected"), [(0, 1), (1.6, 3), (40, 8), (None, 8)])
def test_processes_are_as_many_as_memory_is_there_for(
    free: float | None, expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_set(tmp_path / "captures", patterns=1)
    a_process = process_bytes(read_bench(tmp_path / "captures" / "bench.toml"))
    assert 0.4 * GB < a_process < 0.53 * GB
    monkeypatch.setattr(process_memory, "cores", lambda: 8)
    monkeypatch.setattr(process_memory, "available_bytes", lambda: None if free is None else int(free * GB))
    threads = torch.get_num_threads()
    try:
        assert workers_of(args(tmp_path / "captures")) == expected
        assert workers_of(args(tmp_path / "captures", 5)) == 5  # who asks for a number gets it
        assert workers_of(args(tmp_path / "nothing here")) == 8  # which is said where captures are read
    finally:
        torch.set_num_threads(threads)
