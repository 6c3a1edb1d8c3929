"""Patterns that differ, exposures that do not saturate, and a capture set that reads and passes its check."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.virtual import VirtualHeadset, load_bench
from trainer.captures import acquire
from trainer.captures.acquire import CaptureSummary, acquire_captures, acquire_from
from trainer.captures.bench_file import Bench, read_bench
from trainer.captures.capture_set import read_captures
from trainer.captures.check_set import check_captures
from trainer.captures.patterns import choose_patterns, default_count
from trainer.effects.testing import small_bench
from trainer.model.model_stages import ideal_irradiance

ROWS, COLUMNS, DISTANCE = 72, 96, 6.0


def small(name: str, seed: int = 0) -> tuple[VirtualHeadset, Bench]:
    headset = VirtualHeadset(load_bench(f"virtual:{name}").resized(ROWS, COLUMNS, DISTANCE), seed)
    tables = headset.description.nominal()
    tables["panel"]["levels"] = int(tables["panel"]["levels"])
    return headset, read_bench(tables)


def take(folder: Path, name: str, **options: object) -> CaptureSummary:
    headset, bench = small(name)
    return acquire_captures(headset, bench, folder, **options)  # type: ignore[arg-type]


def test_the_patterns_are_many_kinds_and_use_every_gray_level() -> None:
    patterns = choose_patterns(small_bench(), "green", 6.0, 12)
    kinds = [p.kind for p in patterns]
    assert len(set(kinds)) == 8
    assert len({p.gray.tobytes() for p in patterns}) == 12
    assert all(p.gray.dtype == np.uint8 and p.gray.shape == (72, 96) for p in patterns)
    used = np.bincount(np.concatenate([p.gray.ravel() for p in patterns[:7]]), minlength=256)
    assert used.min() > 20
    held_out, fitted = set(kinds[1::3]), {k for i, k in enumerate(kinds) if i % 3 != 1}
    assert held_out <= fitted


def test_the_same_seed_gives_the_same_patterns_and_another_does_not() -> None:
    first, again, other = (choose_patterns(small_bench(), "green", 6.0, 4, seed) for seed in (1, 1, 2))
    assert all((a.gray == b.gray).all() for a, b in zip(first, again, strict=True))
    assert not (first[1].gray == other[1].gray).all()


def test_a_picture_is_seen_in_the_image_plane() -> None:
    headset, bench = small("ideal")
    from trainer.captures.patterns import _picture

    for index, number in ((0, 0), (2, 1)):
        pattern = choose_patterns(bench, "green", DISTANCE, 3)[index]
        seen = headset.true_irradiance(pattern.gray, "green")
        assert np.corrcoef(seen.ravel(), _picture(bench.panel.shape, number).ravel())[0, 1] > 0.6


def test_a_set_is_sound_with_a_repeat_for_the_noise(tmp_path: Path) -> None:
    steps: list[float] = []
    taken = take(tmp_path / "set", "ideal", progress=lambda done, what: steps.append(done))
    captures = read_captures(tmp_path / "set")
    assert len(captures) == taken.captures == default_count(1) + 1 == 13
    assert captures.captures[0].pattern == captures.captures[1].pattern
    assert taken.saturated < 0.003
    assert len({c.exposure_ms for c in captures.captures}) == 1
    brightest = max(float(np.quantile(captures.counts(c), 0.99)) for c in captures.captures)
    assert brightest > 0.4 * captures.bench.camera.saturation
    assert [c.time_s for c in captures.captures] == sorted(c.time_s for c in captures.captures)
    assert not [p for p in check_captures(tmp_path / "set", ideal_irradiance) if p.severity == "error"]
    assert steps == sorted(steps)
    assert (steps[0], steps[-1]) == (0.0, 1.0)


def test_each_colour_and_plane_has_its_patterns_and_its_exposure(tmp_path: Path) -> None:
    taken = take(tmp_path / "set", "colour", patterns=2, planes_mm=[5.0, 7.0], channels=["blue", "red"])
    captures = read_captures(tmp_path / "set")
    assert captures.channels == ("red", "blue")
    assert captures.planes == (5.0, 7.0)
    assert len(captures) == 2 * 2 * 3
    assert set(taken.exposure_ms) == {"red", "blue"}
    assert len({c.pattern for c in captures.captures}) == 8


def test_a_bright_bench_gets_a_short_exposure(tmp_path: Path) -> None:
    description = load_bench("virtual:ideal").resized(ROWS, COLUMNS, DISTANCE)
    description = replace(description, simulation=replace(description.simulation, signal_share=5.0))
    _, bench = small("ideal")
    taken = acquire_captures(VirtualHeadset(description), bench, tmp_path / "set", 3)
    assert taken.exposure_ms["green"] < 1.0
    assert 0 < taken.saturated < 0.003


@pytest.mark.parametrize("knee_share", [0.42, 0.2])
def test_pixels_that_are_full_below_the_top_count_get_a_shorter_exposure(
    knee_share: float, tmp_path: Path
) -> None:
    straight = take(tmp_path / "straight", "ideal", patterns=3).exposure_ms["green"]
    description = load_bench("virtual:sensor_response").resized(ROWS, COLUMNS, DISTANCE)
    (response,) = description.defects
    description = replace(description, defects=(replace(response, knee_share=knee_share),))
    _, bench = small("ideal")
    taken = acquire_captures(VirtualHeadset(description), bench, tmp_path / "bent", 3)
    assert not [p for p in check_captures(tmp_path / "bent", ideal_irradiance) if p.kind == "saturated"]
    # From where the curve bends to where twice the light gives a quarter more: s / knee from about 1 to 2.2.
    assert knee_share * straight < taken.exposure_ms["green"] < 3 * knee_share * straight


def test_pixels_that_are_full_below_the_top_count_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of captures whose exposure was chosen by the top count alone."""
    monkeypatch.setattr(acquire, "may_be_full", lambda *_: False)
    description = load_bench("virtual:sensor_response").resized(ROWS, COLUMNS, DISTANCE)
    (response,) = description.defects
    description = replace(description, defects=(replace(response, knee_share=0.1),))
    acquire_captures(VirtualHeadset(description), small("ideal")[1], tmp_path / "set", 4)
    (found,) = (p for p in check_captures(tmp_path / "set", ideal_irradiance) if p.kind == "saturated")
    assert (found.severity, found.capture) == ("warning", "")
    assert re.search(r"4 of 4 patterns all count 1[01] % of full scale: they seem", found.message)


def test_a_curve_that_bends_everywhere_gets_the_usual_exposure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    headset, bench = small("ideal")
    full = bench.camera.full_scale
    straight = headset.camera.capture

    def gamma() -> np.ndarray:
        light = np.clip(straight().astype(float) - bench.camera.black_level, 0, None) / full
        return np.rint(bench.camera.black_level + full * light ** (1 / 2.2)).astype(np.uint16)

    monkeypatch.setattr(headset.camera, "capture", gamma)
    acquire_captures(headset, bench, tmp_path / "set", 3)
    captures = read_captures(tmp_path / "set")
    assert max(float(np.quantile(captures.counts(c), 0.999)) for c in captures.captures) > 0.7 * full


def test_a_camera_that_sets_its_exposure_itself_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    headset, bench = small("ideal")
    full = np.full(headset.camera.shape, round(0.6 * bench.camera.full_scale), np.uint16)
    monkeypatch.setattr(headset.camera, "capture", lambda: full)
    with pytest.raises(InputError, match="switch off its automatic exposure"):
        acquire_captures(headset, bench, tmp_path / "set", 3)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spec": "virtual:demoo"}, "did you mean 'demo'"),
        ({"spec": "somewhere"}, "virtual:NAME"),
        ({"channels": ["gren"]}, "did you mean 'green'"),
        ({"planes_mm": [9999.0]}, "-2000 to 2000"),
        ({"patterns": 0}, "at least one"),
    ],
)
def test_what_cannot_be_captured_gets_a_sentence(tmp_path: Path, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        acquire_from(**{"spec": "virtual:ideal", "folder": tmp_path / "set", "patterns": 1, **options})
    assert not list(tmp_path.iterdir())


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        acquire_from("virtual:ideal", tmp_path, 1)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_a_dark_bench_is_said_to_be_dark(tmp_path: Path) -> None:
    headset, bench = small("ideal")
    headset.lasers.set_power = lambda channel, fraction: None  # type: ignore[method-assign]
    with pytest.raises(InputError, match="sees nothing"):
        acquire_captures(headset, bench, tmp_path / "set", 1)
