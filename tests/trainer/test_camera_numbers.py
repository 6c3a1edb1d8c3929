"""Full well and read noise measured from repeated pictures, and what the commands do with them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import convolve1d, gaussian_filter

from runtime.excess import prediction_errors
from tests.trainer.hidden import captured, ran
from trainer.captures.bench_file import Camera
from trainer.captures.camera_noise import compare_repeats
from trainer.captures.camera_numbers import camera_by_repeats, photon_transfer
from trainer.captures.capture_set import read_captures
from trainer.cli import main
from trainer.diagnosis.bench_facts import camera_facts
from trainer.diagnosis.verdict import below_the_noise

SHAPE = (120, 160)


def camera(**stated: object) -> Camera:
    numbers = {"bit_depth": 12, "black_level": 64.0, "full_well_e": 10500.0, "read_noise_e": 5.0}
    return Camera(SHAPE[1], SHAPE[0], 8.0, True, **{**numbers, **stated})


def pictures(rng: np.random.Generator, well: float = 10500, read: float = 5) -> list[np.ndarray]:
    """Two pictures of one speckle by a 12-bit camera, electron by electron."""
    electrons = 0.15 * well * rng.exponential(1, SHAPE)
    taken = []
    for _ in range(2):
        counted = rng.poisson(electrons) + read * rng.normal(size=SHAPE)
        taken.append(np.clip(np.rint(64 + (4095 - 64) / well * counted), 0, 4095).astype(np.uint16))
    return taken


def edit(captures: Path, old: str, new: str) -> None:
    text = (captures / "bench.toml").read_text()
    assert old in text
    (captures / "bench.toml").write_text(text.replace(old, new))


def without_repeats(captures: Path) -> None:
    table = captures / "captures.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([lines[0], *lines[2:]]) + "\n")


def test_full_well_and_read_noise_come_back() -> None:
    rng = np.random.default_rng(1)
    for well, read in ((10500, 5), (5200, 20), (30000, 40)):
        repeats = compare_repeats(*pictures(rng, well, read), camera(full_well_e=10500.0, read_noise_e=read))
        assert repeats is not None
        found = photon_transfer([repeats], camera(read_noise_e=read))
        assert found is not None
        assert abs(found.full_well_e - well) < 4 * found.full_well_error < 0.15 * well
        assert found.read_noise_e == pytest.approx(read, abs=0.3 * read + 8)


def test_right_numbers_are_kept_and_wrong_ones_replaced() -> None:
    taken = pictures(np.random.default_rng(2))
    for well, kept in ((10500, True), (10200, True), (21000, False), (5250, False), (13000, False)):
        stated = camera(full_well_e=float(well))
        repeats = compare_repeats(*taken, stated)
        assert repeats is not None
        used = camera_by_repeats(stated, [repeats])
        assert (used == stated) == kept
        if not kept:
            assert used.full_well_e == pytest.approx(10500, rel=0.05)


def test_a_shaken_repeat_is_not_taken_for_noise() -> None:
    rng = np.random.default_rng(3)
    first, second = pictures(rng)
    repeats = compare_repeats(first, np.roll(second, 1, axis=1), camera())
    assert repeats is not None and repeats.ratio > 3
    assert camera_by_repeats(camera(), [repeats]) == camera()


@pytest.mark.parametrize(("speckle_px", "axes"), [(0.6, (0,)), (0.5, (0, 1))])
def test_a_repeat_that_is_a_little_more_blurred_is_not_taken_for_noise(
    speckle_px: float, axes: tuple[int, ...]
) -> None:
    """The variance of the difference rises with brightness, and neighbouring pixels hardly differ alike."""
    rng = np.random.default_rng(6)
    light = gaussian_filter(0.15 * 10500 * rng.exponential(1, SHAPE), speckle_px)
    taken = []
    for share in (0.0, 0.02):  # of a pixel's light that goes to each neighbour
        for axis in axes:
            light = convolve1d(light, [share, 1 - 2 * share, share], axis)
        counted = rng.poisson(light) + 5 * rng.normal(size=SHAPE)
        taken.append(np.rint(64 + (4095 - 64) / 10500 * counted).astype(np.uint16))
    repeats = compare_repeats(*taken, camera())
    assert repeats is not None and repeats.ratio > 1.1
    assert camera_by_repeats(camera(), [repeats]) == camera()


def test_one_picture_with_noise_of_its_own_is_not_the_cameras() -> None:
    rng = np.random.default_rng(4)
    first, second = pictures(rng)
    noisy = np.clip(second + rng.normal(0, 60, SHAPE), 64, 4095).astype(np.uint16)
    repeats = compare_repeats(first, noisy, camera())
    assert repeats is not None and camera_by_repeats(camera(), [repeats]) == camera()


def test_less_error_than_noise_is_below_the_noise_and_chance_is_not() -> None:
    rng = np.random.default_rng(5)
    light = 200 * rng.exponential(1, (3, *SHAPE))
    signal = light + np.sqrt(light) * rng.normal(size=light.shape)
    mask = np.ones_like(light)
    for factor, below in ((1.0, False), (0.9, False), (2.0, True), (1.3, True)):
        errors = prediction_errors(("a", "b", "c"), signal, light, factor * light, mask)
        assert below_the_noise(errors) == below


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("full_well_e = 10500.0", "full_well_e = 21000", "full_well_e = 21000"),
        ("full_well_e = 10500.0", "full_well_e = 5250", "full_well_e = 5250"),
        ("full_well_e = 10500.0\nread_noise_e = 5.0\n", "", "does not state the camera's noise"),
    ],
    ids=["twice", "half", "silent"],
)
def test_commands_measure_the_noise_and_say_so(old, new, says, tmp_path, capsys) -> None:
    captures = captured(capsys, tmp_path)
    edit(captures, old, new)
    problems = ran(capsys, "check", captures)["problems"]
    assert [(p["severity"], p["kind"]) for p in problems] == [("warning", "camera_numbers")]
    assert says in problems[0]["message"]
    assert main(["compare", str(captures), "--json"]) == 0
    out, err = capsys.readouterr()
    assert says in err
    found = json.loads(out)
    assert abs(found["heldout"]["excess"]) < 1e-4
    assert found["camera"]["measured"]
    assert found["camera"]["full_well_e"] == pytest.approx(10500, rel=0.05)
    facts = {f.fact: f for f in camera_facts(read_captures(captures))}
    if new:
        well, depth = facts["camera.full_well_e"], facts["camera.bit_depth"]
        assert well.value == pytest.approx(10500, rel=0.05)
        assert (well.stated, depth.value) in [(21000, 13), (5250, 11)]
    else:  # nothing is stated that could be wrong
        assert not facts


def test_too_many_bits_show_at_the_top_count_and_in_the_noise(tmp_path, capsys) -> None:
    captures = captured(capsys, tmp_path)
    edit(captures, "bit_depth = 12", "bit_depth = 13")
    assert main(["check", str(captures), "--json"]) == 1
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert [(p["severity"], p["kind"]) for p in problems] == [
        ("error", "bit_depth"),
        ("warning", "camera_numbers"),
    ]
    assert "write bit_depth = 12" in problems[0]["message"]
    assert "bit_depth = 12 instead of 13" in problems[1]["message"]
    assert main(["explain", str(captures), "--out", str(tmp_path / "model.toml")]) == 2
    assert "write bit_depth = 12" in capsys.readouterr().err


def test_without_repeats_a_negative_excess_is_never_complete(tmp_path, capsys) -> None:
    captures = captured(capsys, tmp_path)
    edit(captures, "full_well_e = 10500.0", "full_well_e = 5250")
    without_repeats(captures)
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml", "--workers", 1)
    assert found["verdict"] == "outside_catalogue" and len(found["steps"]) == 1
    shown = re.search(r"what remains shows full_well_e = ([\d.e+]+)", found["sentence"])
    assert shown and float(shown[1]) == pytest.approx(10500, rel=0.1)
    assert "full_well_e = 5250" in found["sentence"] and "capture one pattern twice" in found["sentence"]
    assert ran(capsys, "diagnose", captures, "--workers", 1)["verdict"] == "outside_catalogue"


def test_a_silent_bench_without_repeats_says_what_is_assumed(tmp_path, capsys) -> None:
    captures = captured(capsys, tmp_path)
    edit(captures, "full_well_e = 10500.0\nread_noise_e = 5.0\n", "")
    without_repeats(captures)
    problems = ran(capsys, "check", captures)["problems"]
    assert [p["kind"] for p in problems] == ["camera_numbers"] and "capture one pattern twice" in problems[0][
        "message"
    ]


def test_one_of_the_two_numbers_alone_is_refused(tmp_path, capsys) -> None:
    captures = captured(capsys, tmp_path)
    edit(captures, "read_noise_e = 5.0\n", "")
    assert main(["compare", str(captures)]) == 2
    assert "camera.read_noise_e is missing" in capsys.readouterr().err
