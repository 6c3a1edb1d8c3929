"""The command `next`: patterns ready to show, sets that grow on a bench, and what it says where it cannot."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from firmware_iface.errors import DeviceError
from firmware_iface.virtual import VirtualHeadset
from tests.trainer.extended_source import FEW, captured, extended_source
from tests.trainer.hidden import bench_file, ran, with_few_effects
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.cli import main

pytestmark = pytest.mark.usefixtures("few_candidates")


@pytest.fixture(autouse=True)
def _one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.fitting.pool.cores", lambda: 1)


@pytest.fixture
def few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands know four effects: what is tested is not the catalogue's."""
    with_few_effects(monkeypatch, *FEW)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return extended_source(tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module")
def captures(bench: Path) -> CaptureSet:
    return captured(bench)


def test_patterns_are_written_ready_to_show(
    captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "patterns"
    command = ("next", captures.folder, "--count", 3, "--out", out, "--workers", 1)
    found = ran(capsys, *command)
    assert found["verdict"] == "missing" and found["settled"] is False
    assert found["out"] == str(out)
    assert [{d["effect"], d["rival"]} for d in found["in_doubt"]] == [{"spatial_coherence", "sensor_blur"}]
    with (out / "patterns.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [r["capture"] for r in rows] == [c["capture"] for c in found["captures"]]
    assert len(rows) == 3
    for row, one in zip(rows, found["captures"], strict=True):
        assert {"capture", "channel", "plane_mm", "pattern", "phase", "exposure_ms", "why"} <= set(row)
        assert one["expected_gain"] > 0 and one["why"] == row["why"]
        assert float(row["plane_mm"]) == one["plane_mm"] and float(row["exposure_ms"]) == one["exposure_ms"]
        with Image.open(out / row["phase"]) as picture:
            assert picture.mode == "L" and picture.size == (96, 64)
    assert sorted(p.name for p in out.iterdir()) == ["patterns.csv", "phase"]
    assert main([str(word) for word in command]) == 2
    assert "is there already" in capsys.readouterr().err


def test_on_a_bench_it_captures_until_the_verdict_is_settled(
    bench: Path, captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = captures.content_hash()
    out = tmp_path / "more"
    found = ran(capsys, "next", captures.folder, "--bench", bench, "--count", 6, "--out", out, "--workers", 1)
    assert found["settled"] is True and found["verdict"] == "missing"
    assert found["in_doubt"] == [] and found["explained_by"] == ["spatial_coherence"]
    assert found["simulated"] is True
    assert "spatial_coherence is missing" in found["sentence"]
    assert 2 <= len(found["captures"]) <= 4
    assert captures.content_hash() == before
    grown = read_captures(out)
    assert len(grown) == len(captures) + len(found["captures"])
    for old, one in zip(captures.captures, grown.captures, strict=False):
        assert np.array_equal(captures.counts(old), grown.counts(one))
    for row, one in zip(found["captures"], grown.captures[len(captures) :], strict=True):
        assert (row["capture"], row["plane_mm"], row["exposure_ms"]) == (
            one.capture,
            one.plane_mm,
            one.exposure_ms,
        )
        assert row["phase"] == one.phase.relative_to(out).as_posix()
    times = [c.time_s for c in grown.captures]
    assert times == sorted(times) and len(set(times)) == len(times)
    assert main(["check", str(out)]) == 0


@pytest.mark.parametrize(("stop", "code"), [(KeyboardInterrupt, 130), (DeviceError("it is dark."), 2)])
def test_captures_taken_before_it_stopped_are_kept(
    stop: BaseException | type[BaseException],
    code: int,
    bench: Path,
    captures: CaptureSet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Ctrl-C, or a camera that fails, at the second capture."""
    real, shown = VirtualHeadset._capture, []

    def capture_or_stop(self: VirtualHeadset) -> np.ndarray:
        shown.append(self.plane_mm)
        if len(shown) == 2:
            raise stop
        return real(self)

    monkeypatch.setattr(VirtualHeadset, "_capture", capture_or_stop)
    out = tmp_path / "more"
    line = ["next", str(captures.folder), "--bench", str(bench), "--count", "4", "--out", str(out)]
    assert main([*line, "--workers", "1"]) == code
    assert f"1 further capture was taken and is kept in {out}" in capsys.readouterr().err
    assert len(read_captures(out)) == len(captures) + 1


def test_nothing_is_captured_where_nothing_is_in_doubt(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = bench_file(tmp_path, width=96, height=64, distance_mm=8)
    acquire_from(str(spec), tmp_path / "captures", patterns=4)
    found = ran(
        capsys,
        *("next", tmp_path / "captures", "--bench", spec, "--count", 4, "--out", tmp_path / "more"),
        *("--workers", 1),
    )
    assert (found["verdict"], found["settled"], found["captures"]) == ("complete", True, [])
    assert len(read_captures(tmp_path / "more")) == 5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--count", "0"], "--count: '0' is not a whole number from 1"),
        (["--count", "2", "--bench", "virtual:demoo"], "did you mean 'demo'"),
        (["--count", "2", "--bench", "virtual:demo"], "the panel is (rows, columns)"),
        (["--count", "2", "--planes", "near"], "--planes: 'near' is not a number"),
    ],
)
def test_what_cannot_be_done_gets_a_sentence_and_leaves_nothing(
    words: list[str],
    message: str,
    captures: CaptureSet,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    line = ["next", str(captures.folder), *words, "--out", str(tmp_path / "out"), "--workers", "1", "--json"]
    assert main(line) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert message in err
    assert not list(tmp_path.iterdir())
