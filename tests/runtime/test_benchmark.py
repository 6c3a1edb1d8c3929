"""`hololoop-runtime benchmark`: its keys, and figures that agree with each other."""

from __future__ import annotations

import json

import pytest

from runtime.benchmark.measure import LEVELS_DB, SOLVERS, measure
from runtime.cli import main


@pytest.fixture(scope="module")
def measured() -> dict:
    pytest.importorskip("skimage")
    return measure(((72, 128), (54, 96)), solves=5)


def test_the_figures_agree_with_each_other(measured: dict) -> None:
    assert measured["iteration_over_floor"] == pytest.approx(
        measured["iteration_ms"] / measured["fft_floor_ms"], rel=0.05
    )
    assert [size["pixels"] for size in measured["scaling"]] == [72 * 128, 54 * 96]
    assert set(measured["psnr_by_iteration"]) == set(measured["time_to_psnr"]) == set(SOLVERS)
    for name, curve in measured["psnr_by_iteration"].items():
        assert len(curve) == SOLVERS[name][2] + 1
        assert curve == sorted(curve)
        times = measured["time_to_psnr"][name]
        assert list(times) == [f"{level:g}" for level in LEVELS_DB]
        reached = [t for t in times.values() if t is not None]
        assert reached == sorted(reached)
        assert len(reached) == sum(curve[-1] >= level for level in LEVELS_DB)
        shown = list(measured["psnr_by_ms"][name].values())
        assert shown == sorted(shown)
    assert measured["latency_ms"]["p50"] <= measured["latency_ms"]["p95"] <= measured["latency_ms"]["p99"]
    assert measured["peak_memory_mb"] > 10


def test_bfgs_is_ahead_of_the_others_at_equal_iterations(measured: dict) -> None:
    curves = measured["psnr_by_iteration"]
    assert curves["bfgs"][20] > max(curves[name][20] for name in ("adam", "gerchberg_saxton"))


def test_it_is_printed_as_one_object_or_a_table(
    measured: dict, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.benchmark.measure.measure", lambda **options: measured)
    assert main(["benchmark", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == measured
    assert main(["benchmark"]) == 0
    assert "ratio" in capsys.readouterr().out
