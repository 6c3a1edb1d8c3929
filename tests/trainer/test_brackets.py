"""Exposure brackets: merged to the noise that photons allow, taken by `capture --bracket`, and checked."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.virtual import VirtualHeadset, load_bench
from firmware_iface.virtual.defects import make_defect
from tests.trainer.made_sets import bench_tables, counted, irradiance
from trainer.captures.acquire import acquire_captures
from trainer.captures.batches import load
from trainer.captures.bench_file import read_bench
from trainer.captures.brackets import merged
from trainer.captures.camera_numbers import repeated_pairs
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_writer import CaptureWriter
from trainer.captures.check_set import check_captures
from trainer.captures.patterns import Pattern
from trainer.captures.signal_present import with_signal
from trainer.cli import main
from trainer.model.model_stages import ideal_irradiance

SHAPE, DISTANCE_MM = (72, 96), 6.0


def lens(number: int) -> np.ndarray:
    """Gray levels of a lens beside the axis: a bright spot on the image plane, and dark round it."""
    y = (np.arange(SHAPE[0]) - SHAPE[0] / 2 + 0.5)[:, None] * 8e-6
    x = (np.arange(SHAPE[1]) - SHAPE[1] / 2 + 0.5)[None, :] * 8e-6
    path = -(y**2 + x**2) / (2 * 1.6 * DISTANCE_MM * 1e-3) + (number - 2) * 4e-3 * (x + y)
    return np.floor(path / 520e-9 % 1 * 256).astype(np.uint8)


def spots(channel: str, plane_mm: float) -> list[Pattern]:
    return [Pattern("lens", lens(number)) for number in range(5)]


def take(folder: Path, frames: int, *defects: Any) -> tuple[VirtualHeadset, CaptureSet]:
    description = replace(load_bench("virtual:ideal").resized(*SHAPE, DISTANCE_MM), defects=defects)
    headset = VirtualHeadset(description, 3)
    tables = description.nominal()
    tables["panel"]["levels"] = 256
    acquire_captures(headset, read_bench(tables), folder, choose=spots, frames=frames)
    return headset, read_captures(folder)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[VirtualHeadset, CaptureSet]:
    return take(tmp_path_factory.mktemp("bracket") / "set", 3)


def test_a_merged_picture_has_the_noise_that_its_variance_says(
    bench: tuple[VirtualHeadset, CaptureSet],
) -> None:
    headset, captures = bench
    assert len(captures) == 6
    camera = captures.bench.camera
    gain = camera.counts_per_electron
    below, above, dark, off = [], [], [], []
    for capture in captures.captures:
        short, middle, long = (row.exposure_ms for row in capture.rows)
        assert capture.exposure_ms == short
        assert (middle / short, long / short) == pytest.approx((4, 16))
        truth = (headset.expected_counts(captures.gray(capture), "green") - camera.black_level) / 10
        measured = captures.measured(capture)
        z = (measured.signal - truth * short) / np.sqrt(measured.variance)
        assert np.mean(z[measured.valid] ** 2) == pytest.approx(1, abs=0.06)
        off.append(np.mean(z[measured.valid]))
        single = captures.counts(capture.rows[1]).astype(float) - camera.black_level
        where = truth * long < 0.5 * camera.full_scale
        assert 0.3 < where.mean() < 0.999
        below.append(((measured.signal / short - truth) ** 2)[where])
        above.append(((single / middle - truth) ** 2)[where])
        electrons = truth[where, None] * np.array([short, middle, long]) / gain
        exposures = np.array([short, middle, long])
        dark.append(1 / (exposures**2 / (electrons + 25 + 1 / 12 / gain**2)).sum(1) * gain**2)
    # A capture's own mean scatters by 0.012; the variance comes from the signal, so bright pixels count less: -0.03.
    assert abs(np.mean(off)) < 0.05 and np.abs(off - np.mean(off)).max() < 0.05
    fell = np.concatenate(below).mean() / np.concatenate(above).mean()
    assert np.concatenate(below).mean() == pytest.approx(np.concatenate(dark).mean(), rel=0.05)
    assert fell < 0.3  # shot noise alone: 1 of 5.25 times the light; with read noise less


def test_pixels_that_are_saturated_come_back(bench: tuple[VirtualHeadset, CaptureSet]) -> None:
    headset, captures = bench
    camera = captures.bench.camera
    back = 0
    for capture in captures.captures:
        truth = (headset.expected_counts(captures.gray(capture), "green") - camera.black_level) / 10
        measured = captures.measured(capture)
        short, middle, long = (captures.counts(row) >= camera.saturation for row in capture.rows)
        assert long.sum() > middle.sum() >= short.sum()
        assert (measured.valid == ~short).all()
        returned = middle & ~short
        back += int(returned.sum())
        error = measured.signal - truth * capture.exposure_ms
        assert (np.abs(error)[returned] < 5 * np.sqrt(measured.variance[returned])).all()
    assert back > 20


def test_one_frame_is_itself_and_no_frame_is_invalid() -> None:
    camera = read_bench(bench_tables()).camera
    counts = np.array([[64, 65, 1000, 4095]], np.uint16)
    one = merged([counts], [1.0], camera)
    assert one.signal.tolist() == [[0, 1, 936, 4031]]
    assert one.valid.tolist() == [[True, True, True, False]]
    two = merged([counts, np.full_like(counts, 4095)], [1.0, 4.0], camera)
    assert two.signal.tolist() == one.signal.tolist()
    assert two.valid.tolist() == one.valid.tolist()
    assert np.allclose(two.variance, one.variance)


def make_brackets(folder: Path, exposures: tuple[float, ...] = (2.5, 10.0, 40.0), dim: float = 0.08) -> Path:
    """Five brackets of random patterns, the first of them twice; the long exposure saturates."""
    tables, rng = bench_tables(), np.random.default_rng(5)
    with CaptureWriter(folder, tables) as writer:
        for number, gray in enumerate(rng.integers(0, 256, (5, 64, 80), dtype=np.uint8)):
            light = irradiance(gray)
            for repeat in range(2 if number == 0 else 1):
                for exposure in exposures:
                    counts = counted(light, tables, rng, dim * exposure / 10)
                    name = f"b{number}-{repeat}"
                    writer.add(
                        gray, counts, "green", pattern=f"p{number}", exposure_ms=exposure, bracket=name
                    )
    return folder


def test_repeated_brackets_show_the_cameras_noise(tmp_path: Path) -> None:
    bench = make_brackets(tmp_path / "set") / "bench.toml"
    kept = [
        line
        for line in bench.read_text().splitlines(True)
        if not line.startswith(("full_well", "read_noise"))
    ]
    bench.write_text("".join(kept))
    captures = read_captures(tmp_path / "set")
    assert not captures.bench.camera.noise_stated
    assert [(a.capture, b.capture) for a, b in repeated_pairs(captures.captures)] == [
        ("0000", "0003"),
        ("0001", "0004"),
        ("0002", "0005"),
    ]
    camera = captures.noise_camera()
    assert camera.full_well_e == pytest.approx(10500, rel=0.05)
    assert camera.read_noise_e == pytest.approx(5, abs=1)


def test_drift_of_the_laser_within_a_bracket_is_taken_out(tmp_path: Path) -> None:
    headset, captures = take(
        tmp_path / "set", 3, make_defect("laser_drift", sine_share=0.03, walk_share=0.01)
    )
    for capture in captures.captures[1:]:
        truth = headset.expected_counts(captures.gray(capture), "green") - captures.bench.camera.black_level
        measured = captures.measured(capture)
        weight = measured.valid / measured.variance
        scale = (weight * truth * measured.signal).sum() / (weight * truth**2).sum()
        z = (measured.signal - scale * truth)[measured.valid] / np.sqrt(measured.variance[measured.valid])
        assert np.mean(z**2) < 1.15
    assert [p for p in check_captures(captures.folder, ideal_irradiance) if p.kind == "bracket"] == []


def test_a_batch_knows_the_bracket_before(bench: tuple[VirtualHeadset, CaptureSet]) -> None:
    _, captures = bench
    (batch,) = load(captures, captures.captures[2:4])
    before = batch.shown_before().numpy()
    assert (before[0, 0] == captures.gray(captures.captures[1])).all()
    assert (before[1, 0] == captures.gray(captures.captures[2])).all()
    assert (before[1, 1] == captures.gray(captures.captures[1])).all()
    measured = captures.measured(captures.captures[2])
    assert np.array_equal(batch.noise[0].numpy(), measured.variance)
    assert batch.exposure[0] == pytest.approx(captures.captures[2].exposure_ms)


def problems(folder: Path) -> list[tuple[str, str, str]]:
    return [(p.severity, p.kind, p.message) for p in check_captures(folder, ideal_irradiance)]


def test_a_sound_set_of_brackets_has_no_problems_though_frames_are_saturated_or_dark(tmp_path: Path) -> None:
    folder = make_brackets(tmp_path / "set", (0.01, 2.5, 100.0))
    assert problems(folder) == []
    captures = read_captures(folder)
    assert with_signal(captures)[1] == {}
    assert [c.capture for c in captures.captures] == ["0000", "0003", "0006", "0009", "0012", "0015"]


def test_the_hash_covers_every_frame(tmp_path: Path) -> None:
    folder = make_brackets(tmp_path / "set")
    before = read_captures(folder).content_hash()
    (folder / "image" / "0001.png").write_bytes((folder / "image" / "0002.png").read_bytes())
    assert read_captures(folder).content_hash() != before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("phase/0004.png", "phase/0006.png", "captures 0003 and 0004 show different gray levels"),
        (
            "image/0007.png,10.0,7.0,b1-0",
            "image/0007.png,2.5,7.0,b1-0",
            "0006 and 0007 have the same exposure, 2.5 ms",
        ),
        ("1.0,b0-0", "1.0,alone", "'alone' of captures.csv has one capture only"),
        ("1.0,b0-0", "1.0,b2-0", "'b2-0' of captures.csv do not follow each other"),
        ("0004,green,5.0", "0004,green,6.0", "0003 and 0004 are of different channels or planes"),
    ],
)
def test_a_broken_bracket_gets_a_sentence(tmp_path: Path, old: str, new: str, message: str) -> None:
    folder = make_brackets(tmp_path / "set")
    table = folder / "captures.csv"
    text = table.read_text()
    assert old in text
    table.write_text(text.replace(old, new))
    said = [text for severity, kind, text in problems(folder) if (severity, kind) == ("error", "bracket")]
    assert any(message in text for text in said), said
    with pytest.raises(InputError, match="bracket"):
        read_captures(folder)


def test_a_bracket_without_one_of_its_frames_is_named_and_still_read(tmp_path: Path) -> None:
    folder = make_brackets(tmp_path / "set")
    table = folder / "captures.csv"
    table.write_text("".join(line for line in table.read_text().splitlines(True) if "0010" not in line))
    ((severity, kind, message),) = problems(folder)
    assert (severity, kind) == ("warning", "bracket")
    assert "'b2-0' has 2 captures, and most have 3" in message
    assert len(read_captures(folder)) == 6


def test_an_exposure_that_is_not_what_the_pictures_show_is_named(tmp_path: Path) -> None:
    folder = make_brackets(tmp_path / "set")
    table = folder / "captures.csv"
    table.write_text(table.read_text().replace("image/0007.png,10.0", "image/0007.png,8.0"))
    said = [message for severity, kind, message in problems(folder) if kind == "bracket"]
    assert len(said) == 2
    assert "times as bright as 0006 of its bracket, and its exposure is 3.2 times as long" in said[0]


def test_capture_takes_brackets_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text("[panel]\nwidth = 48\nheight = 40\n[propagation]\ndistance_mm = 4\n")
    command = [
        "capture",
        "--bench",
        str(bench),
        "--patterns",
        "4",
        "--bracket",
        "3",
        "--out",
        str(tmp_path / "set"),
    ]
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["captures"], result["bracket"]) == (5, [0.25, 1.0, 4.0])
    captures = read_captures(tmp_path / "set")
    assert len(captures) == 5
    exposure = result["exposure_ms"]["green"]
    assert [row.exposure_ms / exposure for row in captures.captures[0].rows] == pytest.approx([0.25, 1, 4])
    assert main(["check", str(tmp_path / "set"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["captures"] == 5
    assert main([*command, "--overwrite"]) == 0
    assert "5 simulated captures" in " ".join(capsys.readouterr().out.split())


def test_progress_reaches_every_frame(tmp_path: Path) -> None:
    steps: list[float] = []
    description = load_bench("virtual:ideal").resized(40, 48, 4.0)
    tables = description.nominal()
    tables["panel"]["levels"] = 256
    acquire_captures(
        VirtualHeadset(description),
        read_bench(tables),
        tmp_path / "set",
        2,
        frames=3,
        progress=lambda done, what: steps.append(done),
    )
    assert len(steps) == 2 + 3 * 3 + 1
    assert np.allclose(np.diff(steps), 1 / 11)
