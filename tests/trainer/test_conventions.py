"""All sixteen conventions are recovered from data that another light path made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from firmware_iface.errors import InputError
from tests.trainer.made_sets import bench_tables, counted, irradiance, make_set
from trainer.captures.bench_file import Bench, read_bench
from trainer.captures.conventions import Sample, compare_conventions
from trainer.captures.image_turns import TURNS, turned
from trainer.model.model_stages import ideal_irradiance

BACK = {"turn_90_left": "turn_90_right", "turn_90_right": "turn_90_left"}  # all others undo themselves
TABLES = bench_tables((96, 96))


def sample(bench: Bench, gray: np.ndarray, light: np.ndarray, seed: int) -> Sample:
    counts = counted(light, TABLES, np.random.default_rng(seed))
    signal = counts.astype(np.float32) - 64
    return Sample(f"{seed:04d}", gray, signal, counts < 4095, "green", bench.distance_mm)


def samples(bench: Bench, grays: list[np.ndarray], lights: list[np.ndarray]) -> list[Sample]:
    return [sample(bench, g, s, n) for n, (g, s) in enumerate(zip(grays, lights, strict=True))]


@pytest.fixture(scope="module")
def bench() -> Bench:
    return read_bench(TABLES)


@pytest.fixture(scope="module")
def grays() -> list[np.ndarray]:
    rng = np.random.default_rng(11)
    return [rng.integers(0, 256, (96, 96), dtype=np.uint8) for _ in range(2)]


@pytest.fixture(scope="module")
def lights(grays: list[np.ndarray]) -> dict[int, list[np.ndarray]]:
    return {sign: [irradiance(gray, sign) for gray in grays] for sign in (1, -1)}


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("turn", TURNS)
def test_all_sixteen(
    bench: Bench, grays: list[np.ndarray], lights: dict[int, list[np.ndarray]], turn: str, sign: int
) -> None:
    seen = [np.roll(turned(light, BACK.get(turn, turn)), (2, -3), (0, 1)) for light in lights[sign]]
    result = compare_conventions(bench, samples(bench, grays, seen), ideal_irradiance)
    assert (result.best.turn, result.best.phase_sign) == (turn, sign) and len(result.scores) == 16
    assert result.decisive == ((turn, sign) != ("as_stated", 1)) and result.alike == ()
    assert bool(result.change) == result.decisive
    assert ("phase_sign = -1" in result.change) == (sign == -1)


def test_the_change_is_right(
    bench: Bench, grays: list[np.ndarray], lights: dict[int, list[np.ndarray]]
) -> None:
    """Turning the images as the change says makes the stated convention the best."""
    first = samples(bench, grays, [np.rot90(light) for light in lights[1]])
    result = compare_conventions(bench, first, ideal_irradiance)
    turn = result.best.turn
    corrected = [replace(s, signal=turned(s.signal, turn), valid=turned(s.valid, turn)) for s in first]
    assert result.decisive and "to the right" in result.change
    assert not compare_conventions(bench, corrected, ideal_irradiance).decisive


def test_a_poor_bench_is_no_convention(
    bench: Bench, grays: list[np.ndarray], lights: dict[int, list[np.ndarray]]
) -> None:
    """Blur, a narrow beam, saturation and noise lower the correlation, and no other convention fits."""
    y, x = np.mgrid[-1:1:96j, -1:1:96j]
    beam = np.exp(-((x - 0.3) ** 2 + y**2))
    poor = [gaussian_filter(s, 1.5) * beam * 8 + 0.5 for s in lights[1]]
    result = compare_conventions(bench, samples(bench, grays, poor), ideal_irradiance)
    assert result.best is result.stated and not result.decisive and result.change == ""


def test_other_data_decide_nothing(bench: Bench, grays: list[np.ndarray]) -> None:
    rng = np.random.default_rng(4)
    for _ in range(3):
        other = [irradiance(rng.integers(0, 256, (96, 96))) for _ in grays]
        assert not compare_conventions(bench, samples(bench, grays, other), ideal_irradiance).decisive


def test_what_cannot_be_told_apart_is_said(bench: Bench) -> None:
    """A binary pattern of 0 and pi has no sign; mirrored, either sign corrects it."""
    rng = np.random.default_rng(9)
    gray = rng.choice([0, 128], (96, 96)).astype(np.uint8)
    light = irradiance(gray)
    plain = compare_conventions(bench, [sample(bench, gray, light, 0)], ideal_irradiance)
    assert not plain.decisive
    mirrored = compare_conventions(bench, [sample(bench, gray, light[::-1], 0)], ideal_irradiance)
    assert mirrored.decisive and mirrored.best.turn == "mirror_top_bottom"
    other = ("mirror_top_bottom", -mirrored.best.phase_sign)
    assert [(s.turn, s.phase_sign) for s in mirrored.alike] == [other]
    assert "cannot tell" in mirrored.change


def test_a_stated_sign_is_the_start(grays: list[np.ndarray], lights: dict[int, list[np.ndarray]]) -> None:
    tables = bench_tables((96, 96))
    tables["panel"]["phase_sign"] = -1
    bench = read_bench(tables)
    assert not compare_conventions(
        bench, [sample(bench, grays[0], lights[-1][0], 0)], ideal_irradiance
    ).decisive
    result = compare_conventions(bench, [sample(bench, grays[0], lights[1][0], 0)], ideal_irradiance)
    assert result.decisive and "phase_sign = 1" in result.change


def test_oblong_cameras_cannot_be_transposed(tmp_path: Path) -> None:
    made = make_set(tmp_path / "set")
    distinct = list({c.pattern: c for c in made.captures}.values())[::2]
    several = [Sample(c.capture, made.gray(c), *made.signal(c), c.channel, c.plane_mm) for c in distinct]
    result = compare_conventions(made.bench, several, ideal_irradiance)
    quick = compare_conventions(
        made.bench,
        [sample(made.bench, made.gray(c), made.signal(c)[0] / 300, 0) for c in made.captures[:1]],
        ideal_irradiance,
        quick=True,
    )
    assert quick.best is quick.stated and len(quick.scores) == 4
    assert len(result.scores) == 8 and not result.decisive and result.stated.correlation > 0.8
    assert result.stated.shift == ((0, 0),) * 3
    with pytest.raises(InputError, match="no captures"):
        compare_conventions(made.bench, [], ideal_irradiance)
    with pytest.raises(InputError, match="no way"):
        turned(np.zeros((2, 2)), "upside_down")


def test_a_large_panel_is_compared_at_its_centre() -> None:
    """The cut prediction is that of the whole panel, and mirroring keeps the centre where it is."""
    tables = bench_tables((96, 1300))
    bench = read_bench(tables)
    gray = np.random.default_rng(6).integers(0, 256, (96, 1300), dtype=np.uint8)
    light = irradiance(gray, -1)[:, ::-1]
    counts = counted(light, tables, np.random.default_rng(0))
    whole = Sample("0000", gray, counts.astype(np.float32) - 64, counts < 4095, "green", 5.0)
    asked: list[tuple[int, ...]] = []

    def predict(near: Bench, pattern: np.ndarray, channel: str, plane_mm: float) -> np.ndarray:
        asked.append(pattern.shape)
        return irradiance(pattern, near.panel.phase_sign)

    result = compare_conventions(bench, [whole], predict)
    assert (result.best.turn, result.best.phase_sign, result.decisive) == ("mirror_left_right", -1, True)
    assert max(asked)[1] < 700
