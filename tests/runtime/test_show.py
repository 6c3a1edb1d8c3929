"""`hololoop-runtime show`: on an ideal virtual headset, and on one emulated down to its buses' bytes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from firmware_iface.errors import InputError
from firmware_iface.virtual import open_headset
from runtime.cli import main
from runtime.solver.pattern_files import read_given, read_pattern, write_pattern

pytestmark = pytest.mark.usefixtures("real_time")  # an emulated headset needs its share of the cores

BENCH = """
[panel]
height = 48
width = 64
[propagation]
distance_mm = 8.0
"""


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    path = tmp_path / "bench.toml"
    path.write_text(BENCH, encoding="utf-8")
    return path


@pytest.fixture
def patterns(tmp_path: Path) -> list[Path]:
    paths = []
    for seed in range(2):
        gray = np.random.default_rng(seed).integers(0, 256, (48, 64), dtype=np.uint8)
        paths.append(tmp_path / f"pattern-{seed}.png")
        Image.fromarray(gray).save(paths[-1])
    return paths


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict, str]:
    code = main([str(word) for word in words])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else {}, err


def seen(path: str) -> np.ndarray:
    with Image.open(path) as image:
        assert image.mode.startswith("I;16")
        return np.array(image).astype(float)


@pytest.mark.parametrize("emulated", [False, True])
def test_each_pattern_is_seen_by_the_camera(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, bench: Path, patterns: list[Path], emulated: bool
) -> None:
    """Against the bench's noise-free truth; emulated, through pyusb, smbus2 and, where it is there, depthai."""
    words = ["show", *patterns, "--headset", bench, "--out", tmp_path / "seen", "--exposure-ms", 8, "--json"]
    code, result, err = run(capsys, *words, *(["--emulated"] if emulated else []))
    assert code == 0 and not err and result["exposure_ms"] == 8 and result["channel"] == "green"
    assert result["simulated"] is True
    truth = open_headset(str(bench))
    for path, one in zip(patterns, result["shown"], strict=True):
        counts = seen(one["seen"])
        expected = truth.expected_counts(np.array(Image.open(path)), "green")
        assert np.corrcoef(counts.ravel(), expected.ravel())[0, 1] > 0.97
        assert one["mean_counts"] == pytest.approx(counts.mean(), abs=0.01)
        assert one["brightest_counts"] == counts.max() and one["saturated_share"] < 0.05


COLOUR = (
    BENCH
    + """
[[channel]]
name = "red"
wavelength_nm = 638.0
[[channel]]
name = "green"
wavelength_nm = 520.0
[[channel]]
name = "blue"
wavelength_nm = 450.0
[camera]
bit_depth = 16
"""
)


@pytest.mark.parametrize(
    ("emulated", "given"), [(False, None), (True, None), (False, (2.0, 0.5, 1.0))], ids=str
)
def test_colours_in_turn_are_seen_together(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, emulated: bool, given: tuple[float, ...] | None
) -> None:
    """The camera's picture is the sum of the colours, each of its own pattern, for a sixth of the time at most."""
    bench = tmp_path / "bench.toml"
    bench.write_text(COLOUR, encoding="utf-8")
    colours, paths, grays = ["red", "green", "blue"], [], []
    for name in colours:
        grays.append(np.random.default_rng(len(name)).integers(0, 256, (48, 64), dtype=np.uint8))
        paths.append(tmp_path / f"picture-{name}.png")
        write_pattern(paths[-1], grays[-1], given and given[len(paths) - 1])
    words = ["show", *paths, "--in-turn", ",".join(colours), "--headset", bench, "--exposure-ms", 16.66]
    words += ["--out", tmp_path / "seen", "--json", *(["--emulated"] if emulated else [])]
    code, result, err = run(capsys, *words)
    assert code == 0 and not err, err
    assert result["channel"] == "red,green,blue"
    (one,) = result["shown"]
    assert one["fields"] == {name: str(path) for name, path in zip(colours, paths, strict=True)}
    assert one["seen"] == str(tmp_path / "seen" / "picture-red-seen.png")
    truth = open_headset(str(bench))
    black = truth.description.camera.black_level
    times = [0.5 / one for one in given or (0.5, 0.5, 0.5)]
    alone = [truth.expected_counts(g, c) - black for g, c in zip(grays, colours, strict=True)]
    expected = sum(t * one for t, one in zip(times, alone, strict=True))
    counts = seen(one["seen"])
    expected = expected * 16.66 / 10 / 6
    if counts.max() <= 1023:  # an OAK's ten bits
        expected, black = expected / 64, black / 64
    assert np.corrcoef(counts.ravel(), np.asarray(expected).ravel())[0, 1] > 0.97
    assert counts.mean() - black == pytest.approx(np.mean(expected), rel=0.05)


def test_a_pattern_says_what_it_gives_or_nothing(tmp_path: Path) -> None:
    path, gray = tmp_path / "pattern.png", np.full((4, 6), 7, np.uint8)
    write_pattern(path, gray)
    assert read_given(path) is None
    write_pattern(path, gray, 0.1)
    assert read_given(path) == 0.1 and np.array_equal(read_pattern(path), gray)
    for wrong in (0.0, float("nan"), float("inf"), -1.0):
        write_pattern(path, gray, wrong)
        with pytest.raises(InputError, match="no number above 0"):
            read_given(path)


def test_patterns_that_are_no_pictures_of_these_colours_are_refused(
    capsys: pytest.CaptureFixture[str], bench: Path, patterns: list[Path]
) -> None:
    for words, message in (
        ((*patterns, patterns[0], "--in-turn", "red,green"), "needs 2 patterns a picture, and 3 are given"),
        ((*patterns, "--in-turn", "red"), "not several colours"),
        ((*patterns, "--in-turn", "red,red"), "not several colours"),
        ((*patterns, "--in-turn", "green,blue"), "there is no laser 'blue'"),
        ((*patterns, "--in-turn", "green,blue", "--channel", "green"), "not allowed with"),
    ):
        code, _, err = run(capsys, "show", *words, "--headset", bench)
        assert code == 2 and message in err and err.count("\n") == 1, err


def test_what_cannot_be_shown_says_why(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, bench: Path, patterns: list[Path]
) -> None:
    colour, small = tmp_path / "colour.png", tmp_path / "small.png"
    Image.new("RGB", (64, 48)).save(colour)
    Image.new("L", (8, 8)).save(small)
    text = tmp_path / "text.png"
    text.write_text("no picture", encoding="utf-8")
    good = patterns[0]
    for words, message in (
        ((colour, "--headset", bench), "not 8-bit gray (RGB)"),
        ((small, "--headset", bench), "(48, 64)"),
        ((text, "--headset", bench), "not a picture"),
        ((tmp_path / "none.png", "--headset", bench), "missing"),
        ((good, "--headset", bench, "--channel", "ultraviolet"), "use one of green"),
        ((good, "--headset", bench, "--exposure-ms", 0), "exposure"),
        ((good, "--headset", "virtual:nothing", "--emulated"), "no virtual bench 'nothing'"),
        ((good,), "--headset"),
    ):
        code, _, err = run(capsys, "show", *words)
        assert code == 2 and message in err and err.count("\n") == 1, err
