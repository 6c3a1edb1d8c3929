"""Every fault of a set is found and reported with its capture; sound sets have no problems."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.trainer.made_sets import bench_tables, counted, irradiance, make_set
from trainer.captures.acquire import acquire_from
from trainer.captures.bench_file import Bench, read_bench
from trainer.captures.camera_noise import black_estimate, compare_repeats
from trainer.captures.capture_set import CaptureSet
from trainer.captures.check_set import check_captures
from trainer.captures.problems import Problem
from trainer.model.model_stages import ideal_irradiance

FUZZ = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def flat_prediction(bench: Bench, gray: np.ndarray, channel: str, plane_mm: float) -> np.ndarray:
    """A prediction that fits nothing: for tests that are not about conventions."""
    return np.ones(bench.camera.shape, np.float32)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    return make_set(tmp_path_factory.mktemp("made") / "set")


@pytest.fixture
def copy(made: CaptureSet, tmp_path: Path) -> Path:
    shutil.copytree(made.folder, tmp_path / "copy")
    return tmp_path / "copy"


def found(folder: Path) -> list[tuple[str, str, str]]:
    return [(p.severity, p.kind, p.capture) for p in check_captures(folder, flat_prediction)]


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def repaint(folder: Path, change: object, names: str = "*") -> None:
    for path in sorted((folder / "image").glob(f"{names}.png")):
        Image.fromarray(change(np.asarray(Image.open(path)))).save(path)  # type: ignore[operator]


def test_a_sound_set_has_no_problems(made: CaptureSet) -> None:
    shares: list[float] = []
    assert check_captures(made.folder, ideal_irradiance, lambda done, what="": shares.append(done)) == []
    assert shares == [n / 6 for n in range(1, 7)]


@pytest.mark.parametrize(
    "camera",
    [
        {"bit_depth": 8, "black_level": 4, "full_well_e": 9000, "read_noise_e": 20},
        {"bit_depth": 10, "black_level": 16, "full_well_e": 8000, "read_noise_e": 3},
        {"bit_depth": 16, "black_level": 500, "full_well_e": 30000, "read_noise_e": 2},
        {"black_level": 0, "read_noise_e": 2},
    ],
)
def test_sound_sets_of_other_cameras(tmp_path: Path, camera: dict[str, float]) -> None:
    make_set(tmp_path / "set", bench_tables(**camera))
    assert found(tmp_path / "set") == []


def test_stray_light_and_drift_are_no_fault_of_the_set(tmp_path: Path, made: CaptureSet) -> None:
    make_set(tmp_path / "stray", stray=0.3)
    assert found(tmp_path / "stray") == []
    make_set(tmp_path / "alone", stray=0.3, repeat=False)
    assert found(tmp_path / "alone") == []
    shutil.copytree(made.folder, tmp_path / "drift")
    rng = np.random.default_rng(3)
    light = irradiance(made.gray(made.captures[0])) * 1.1
    Image.fromarray(counted(light, bench_tables(), rng)).save(tmp_path / "drift/image/0001.png")
    assert found(tmp_path / "drift") == []


def test_missing_and_broken_files(copy: Path, made: CaptureSet) -> None:
    (copy / "image/0001.png").unlink()
    (copy / "phase/0002.png").write_bytes((copy / "phase/0002.png").read_bytes()[:-60])
    repaint(copy, lambda a: a[:-1], "0003")
    repaint(copy, lambda a: (a >> 4).astype(np.uint8), "0004")
    Image.new("RGB", (80, 64)).save(copy / "image/0005.png")
    assert found(copy)[:5] == [
        ("error", "missing_file", "0001"),
        ("error", "unreadable", "0002"),
        ("error", "wrong_size", "0003"),
        ("error", "bit_depth", "0004"),
        ("error", "unreadable", "0005"),
    ]


def test_wrong_rows(copy: Path) -> None:
    edit(copy / "captures.csv", "0001,green", "0000,green")
    edit(copy / "captures.csv", "0003,green", "0003,violet")
    edit(copy / "captures.csv", "0004,green,5.0", "0004,green,NaN")
    assert found(copy) == [
        ("error", "duplicate", "0000"),
        ("error", "unknown_channel", "0003"),
        ("error", "not_a_number", "0004"),
        ("warning", "too_few", ""),
    ]


def test_unreadable_tables_are_one_problem(copy: Path) -> None:
    (copy / "captures.csv").write_bytes(b"\xff\xfe\0")
    assert ("error", "unreadable", "") in found(copy)
    (copy / "bench.toml").write_text("schema = ")
    assert found(copy) == [("error", "unreadable", "")]
    assert found(copy / "nowhere") == [("error", "unreadable", "")]


def test_saturation_at_the_top_and_below_it(copy: Path, tmp_path: Path) -> None:
    repaint(copy, lambda a: np.where(a > np.quantile(a, 0.95), 4095, a).astype(np.uint16), "0002")
    repaint(copy, lambda a: np.minimum(a * 8 + a % 8, 3800).astype(np.uint16), "0004")
    assert [p[1:] for p in found(copy)] == [("saturated", "0002"), ("saturated", "0004")]


def test_few_saturated_pixels_are_nothing(copy: Path) -> None:
    repaint(copy, lambda a: np.where(a > np.quantile(a, 0.98), 4095, a).astype(np.uint16), "0002")
    assert found(copy) == []


@pytest.mark.parametrize("up", [lambda a: a << 4, lambda a: (a << 4) | (a >> 8)])
def test_left_justified_counts(copy: Path, up: object) -> None:
    repaint(copy, up)
    assert found(copy) == [("error", "left_justified", f"{n:04d}") for n in range(6)]
    assert "by 16" in check_captures(copy, flat_prediction)[0].message


def test_the_mosaic_of_a_colour_camera_is_noticed(copy: Path) -> None:
    filters = np.array([[0.15, 1.0], [1.0, 0.35]])  # of green light: red, green; green, blue

    def mosaic(counts: np.ndarray) -> np.ndarray:
        tiled = np.tile(filters, [(n + 1) // 2 for n in counts.shape])[: counts.shape[0], : counts.shape[1]]
        return np.rint(64 + tiled * (counts.astype(float) - 64)).astype(np.uint16)

    repaint(copy, mosaic)
    assert found(copy)[0] == ("error", "mosaic", "")
    (text,) = [p.message for p in check_captures(copy, flat_prediction) if p.kind == "mosaic"]
    assert "0.15, 1.00, 1.00, 0.3" in text


def test_one_picture_with_a_pattern_of_two_pixels_is_no_mosaic(copy: Path) -> None:
    def striped(counts: np.ndarray) -> np.ndarray:
        return np.where(np.arange(counts.shape[1]) % 2, counts, 64 + (counts - 64) // 2).astype(np.uint16)

    repaint(copy, striped, "0002")
    assert not [p for p in found(copy) if p[1] == "mosaic"]


def test_patterns_that_alternate_make_no_mosaic(copy: Path) -> None:
    def alternating(counts: np.ndarray) -> np.ndarray:
        return np.where(np.indices(counts.shape).sum(0) % 2, counts, 64 + (counts - 64) // 2).astype(
            np.uint16
        )

    repaint(copy, alternating)
    assert not [p for p in found(copy) if p[1] == "mosaic"]


def test_left_justified_counts_of_a_dim_picture(tmp_path: Path) -> None:
    make_set(tmp_path / "set", brightness=0.003)
    repaint(tmp_path / "set", lambda a: a << 4, "0002")
    assert ("error", "left_justified", "0002") in found(tmp_path / "set")


def test_counts_above_the_stated_depth_and_steps_below_it(copy: Path) -> None:
    repaint(copy, lambda a: (a.astype(int) * 7 + 3).astype(np.uint16), "0002")
    repaint(copy, lambda a: a // 4 * 4, "0003")
    assert found(copy) == [("error", "bit_depth", "0002"), ("warning", "bit_depth", "0003")]


@pytest.mark.parametrize(
    ("stated", "says"),
    [
        (0, "too low"),
        (32, "too low"),
        (96, "too high"),
        (200, "too high"),
    ],
)
def test_wrong_black_level(copy: Path, stated: int, says: str) -> None:
    edit(copy / "bench.toml", "black_level = 64", f"black_level = {stated}")
    problems = check_captures(copy, flat_prediction)
    assert [(p.kind, p.capture) for p in problems] == [("black_level", "")]
    assert says in problems[0].message and f"= {stated}" in problems[0].message


def test_misstated_read_noise_is_not_a_black_level(tmp_path: Path) -> None:
    for actual in (2, 9):
        tables = bench_tables(read_noise_e=actual)
        make_set(tmp_path / str(actual), tables)
        edit(tmp_path / str(actual) / "bench.toml", f"read_noise_e = {actual}", "read_noise_e = 5")
        assert not [f for f in found(tmp_path / str(actual)) if f[1] == "black_level"]


def test_repeats_point_to_the_black_level(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    tables = bench_tables()
    light = irradiance(rng.integers(0, 256, (120, 160))) + 0.2
    pictures = [counted(light * gain, tables, rng) for gain in (1, 1.03)]
    camera = read_bench(tables).camera
    repeats = compare_repeats(*pictures, camera)
    assert repeats is not None and repeats.ratio == pytest.approx(1, abs=0.05)
    estimate = black_estimate([repeats], camera)
    assert estimate is not None and abs(estimate.level - 64) < 4 * estimate.error < 40


def test_repeats_that_differ_by_more_than_noise_do_not_point_to_a_black_level(tmp_path: Path) -> None:
    acquire_from("virtual:slow_response", tmp_path / "captures", patterns=4)
    assert [p[1] for p in found(tmp_path / "captures") if p[1] != "no_correlation"] == ["noise"]


def test_too_few_patterns_say_what_is_enough(tmp_path: Path) -> None:
    make_set(tmp_path / "set", bench_tables(channels=("red", "green")), patterns=3)
    problems = check_captures(tmp_path / "set", flat_prediction)
    assert [(p.severity, p.kind) for p in problems] == [("warning", "too_few")] * 2
    assert "'red' has 3" in problems[0].message and "at least 4" in problems[0].message


def test_noisy_repeats_and_a_repeat_that_is_none(copy: Path, made: CaptureSet) -> None:
    rng = np.random.default_rng(2)
    repaint(copy, lambda a: np.maximum(a + rng.normal(0, 60, a.shape), 64).astype(np.uint16), "0001")
    assert found(copy) == [("warning", "noise", "0001")]
    Image.fromarray(made.gray(made.captures[3])).save(copy / "phase/0001.png")
    assert ("error", "pattern", "0001") in found(copy)


def test_a_dark_picture_is_noticed(copy: Path) -> None:
    rng = np.random.default_rng(5)
    repaint(copy, lambda a: np.round(rng.normal(64, 1.9, a.shape)).astype(np.uint16), "0003")
    assert found(copy) == [("error", "dark", "0003")]


def test_a_flat_picture_with_some_light_is_not_dark(copy: Path) -> None:
    rng = np.random.default_rng(5)
    repaint(copy, lambda a: np.round(rng.normal(74, 1.9, a.shape)).astype(np.uint16), "0003")
    assert found(copy) == [("warning", "no_signal", "0003")]


@pytest.mark.parametrize(
    ("edits", "says"),
    [
        ("mirror", "mirror the images left-right"),
        ("sign", "phase_sign = -1"),
    ],
)
def test_conventions_are_looked_for(copy: Path, edits: str, says: str) -> None:
    if edits == "mirror":
        repaint(copy, lambda a: a[:, ::-1])
    else:
        for path in (copy / "phase").glob("*.png"):
            Image.fromarray((-np.asarray(Image.open(path)).astype(int) % 256).astype(np.uint8)).save(path)
    problems = check_captures(copy, ideal_irradiance)
    assert [(p.severity, p.kind) for p in problems] == [("error", "convention")]
    assert says in problems[0].message


@FUZZ
@given(data=st.data())
def test_nothing_in_the_files_raises(made: CaptureSet, copy: Path, data: st.DataObject) -> None:
    for name in ("bench.toml", "captures.csv", "image/0000.png", "phase/0003.png"):
        whole = (made.folder / name).read_bytes()
        start = data.draw(st.integers(0, len(whole)))
        put = data.draw(st.binary(max_size=6) | st.sampled_from([b"nan", b"-1", b"9e9", b"\n", b'"', b",,"]))
        end = data.draw(st.sampled_from([start, start + 1, start + 9, len(whole)]))
        (copy / name).write_bytes(whole[:start] + put + whole[end:] if data.draw(st.booleans()) else whole)
    assert all(isinstance(p, Problem) and p.message for p in check_captures(copy, flat_prediction))


@pytest.mark.parametrize(
    "names", [("ideal", "leak"), pytest.param((), marks=pytest.mark.slow)], ids=["two of them", "all"]
)
def test_practice_sets_are_clean(names: tuple[str, ...], shared: Path) -> None:
    practice = shared / "practice"
    for folder in [practice / name for name in names] or sorted(practice.iterdir()):
        assert check_captures(folder, ideal_irradiance) == []


def test_images_beside_the_wrong_patterns_are_named_with_the_pattern_they_fit(
    made: CaptureSet, tmp_path: Path
) -> None:
    folder = tmp_path / "swapped"
    shutil.copytree(made.folder, folder)
    images = sorted((folder / "image").glob("*.png"))
    one, other = images[2], images[4]
    first, second = one.read_bytes(), other.read_bytes()
    one.write_bytes(second)
    other.write_bytes(first)
    found = [p for p in check_captures(folder, ideal_irradiance) if p.kind == "mismatched"]
    ids = {c.image.name: c.capture for c in made.captures}
    assert {p.capture for p in found} == {ids[one.name], ids[other.name]}
    assert all(p.severity == "error" for p in found)
    assert f"fits the pattern of capture {ids[other.name]}" in next(
        p.message for p in found if p.capture == ids[one.name]
    )


def test_noise_in_place_of_all_images_fits_no_pattern(made: CaptureSet, tmp_path: Path) -> None:
    folder = tmp_path / "noise"
    shutil.copytree(made.folder, folder)
    rng = np.random.default_rng(0)
    for path in (folder / "image").glob("*.png"):
        shape = np.asarray(Image.open(path)).shape
        Image.fromarray(rng.integers(100, 3000, shape).astype(np.uint16)).save(path)
    kinds = {p.kind for p in check_captures(folder, ideal_irradiance)}
    assert "no_correlation" in kinds and "mismatched" not in kinds
