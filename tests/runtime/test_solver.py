"""Patterns: tested by an independent propagation, through paths with every defect, rounded to gray levels."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath, irradiance, panel_phase, pixel_irradiance
from runtime.solver import DriveRange, Quality, Solver, quality, quality_of, solve
from runtime.solver.array_backend import Backend
from runtime.solver.retrieval_methods import MemorylessBfgs
from tests.runtime.benches import converted, ideal_path, padded_irradiance, random_path, scene

SHAPE, DISTANCE = (96, 128), 0.015


@pytest.fixture(scope="module")
def ideal() -> LightPath:
    return ideal_path(SHAPE, DISTANCE, dtype=np.float32)


def test_beats_double_phase_by_an_independent_propagation(ideal: LightPath) -> None:
    target = scene(SHAPE)
    solution = solve(ideal, target, 30)
    seen = quality(padded_irradiance(2 * np.pi * solution.gray / 256, DISTANCE), target)
    start = quality(padded_irradiance(solve(ideal, target, 0).phase, DISTANCE), target)
    assert seen.psnr_db > start.psnr_db + 6
    assert seen.psnr_db > 24
    # They differ by the light in the frequency bin at the iris's edge.
    assert seen.psnr_db == pytest.approx(solution.quality.psnr_db, abs=3)


def test_double_phase_shows_the_picture_where_the_iris_stops_its_chequerboard() -> None:
    path = ideal_path(SHAPE, DISTANCE, half_width=0.5)
    target = scene(SHAPE)
    gray = solve(path, target, 0).gray
    assert quality_of(path, gray, target).psnr_db > 20
    flat = np.zeros(SHAPE, np.uint8)
    assert quality_of(path, gray, target).psnr_db > quality_of(path, flat, target).psnr_db + 8


@pytest.mark.parametrize(
    ("half_width", "iterations", "turns", "less_db"),
    [
        (0.5, 5, 0.95, 0.5),  # from flat phase, these end at 17 dB
        (0.5, 5, 0.86, 0.5),
        (0.5, 5, 0.75, 1.5),
        (1.0, 20, 0.86, 3.0),  # from double phase, 6 to 7 dB less: an open iris passes its chequerboard
        (1.0, 20, 0.75, 3.0),
    ],
)
def test_a_panel_that_misses_a_part_of_the_turn_comes_nearly_as_near(
    half_width: float, iterations: int, turns: float, less_db: float
) -> None:
    """As in red, where the panel is made for green."""
    whole = ideal_path(SHAPE, DISTANCE, half_width, dtype=np.float32)
    short = replace(whole, response=(turns * 2 * np.pi * np.arange(256) / 255).astype(np.float32))
    target = scene(SHAPE)
    best, reached = (solve(path, target, iterations) for path in (whole, short))
    assert reached.quality.psnr_db > best.quality.psnr_db - less_db
    assert reached.phase.max() <= short.response[-1] + 1e-5


def test_more_iterations_never_give_a_worse_pattern(ideal: LightPath) -> None:
    target = scene(SHAPE, 2)
    qualities = [solve(ideal, target, n).quality.psnr_db for n in (0, 1, 2, 3, 5, 8, 13, 21, 40)]
    assert all(b > a - 0.02 for a, b in pairwise(qualities))
    assert qualities[-1] > qualities[0] + 12


@pytest.mark.parametrize(
    "name", ["leak", "beam", "lines", "filter", "gain", "short_drive", "long_drive", "backwards"]
)
def test_compensates_what_the_ideal_pattern_suffers_from(ideal: LightPath, name: str) -> None:
    """A pattern computed for the true path, against one computed for the ideal path, both through the true one."""
    y, x = np.meshgrid(np.linspace(-1, 1, SHAPE[0]), np.linspace(-1, 1, SHAPE[1]), indexing="ij")
    grid, level = ideal.grid, np.arange(256) / 256
    transfer = ideal.transfers[0]
    frequency = np.fft.rfftfreq(grid.image_shape[1])[None] + 0 * np.fft.fftfreq(grid.image_shape[0])[:, None]
    changes = {
        "leak": {"leak": np.full(SHAPE, 0.25 + 0.1j)},
        "beam": {"source": np.exp(-1.2 * x**2 - 0.8 * y**2 + 2j * x * y)},
        "lines": {
            "transfers": np.stack([transfer, np.exp(0.4j * np.angle(transfer)) * np.abs(transfer)]),
            "weights": np.array([0.8, 0.2]),
        },
        "filter": {"irradiance_filter": 1 + 0.25 * np.exp(-2j * np.pi * frequency * 12)},
        "gain": {"gain": 1 + 0.15 * x},
        "short_drive": {"response": 2 * np.pi * 0.85 * level},
        "long_drive": {"response": 2 * np.pi * 1.25 * level},
        "backwards": {"response": -2 * np.pi * level},
    }
    true = converted(replace(ideal, **changes[name]), np.float32)
    target = scene(SHAPE, 1)
    aware = solve(true, target, 50)
    unaware = quality_of(true, solve(ideal, target, 50).gray, target)
    assert aware.quality.psnr_db > unaware.psnr_db + 2
    assert aware.quality.nrmse < 0.8 * unaware.nrmse


def test_crosstalk_is_compensated(ideal: LightPath) -> None:
    taps = np.array([[0.25, 0.75, 0.0], [0.03, 0.94, 0.03], [0.0, 0.75, 0.25]])
    true = converted(replace(ideal, crosstalk=(taps, taps)), np.float32)
    target = scene(SHAPE, 1)
    aware = solve(true, target, 30)
    unaware = quality_of(true, solve(ideal, target, 30).gray, target)
    assert aware.quality.psnr_db > unaware.psnr_db + 3
    assert aware.phase.min() >= -1e-5
    assert aware.phase.max() <= true.response[-1] + 1e-5  # mixed phases are not the same after a whole turn


def test_the_quality_reported_is_that_of_the_gray_levels(ideal: LightPath) -> None:
    target = scene(SHAPE)
    solution = solve(ideal, target, 10)
    assert solution.gray.dtype == np.uint8
    assert solution.gray.shape == solution.phase.shape == SHAPE
    assert len(solution.psnr_db) == 11
    light = pixel_irradiance(ideal, irradiance(ideal, panel_phase(ideal, solution.gray.astype(int))))
    assert quality(light, target) == solution.quality
    assert solution.quality.psnr_db == pytest.approx(max(solution.psnr_db), abs=0.1)
    np.testing.assert_allclose(light.mean() / target.mean(), solution.quality.scale, rtol=0.1)


def test_fewer_levels_are_used_as_well_as_they_can_be(ideal: LightPath) -> None:
    path = replace(ideal, response=(2 * np.pi * np.arange(256) / 16).astype(np.float32))
    solution = solve(path, scene(SHAPE), 20, levels=16)
    assert solution.gray.max() < 16
    assert solution.quality.psnr_db > 18
    assert solve(ideal, scene(SHAPE), 20).quality.psnr_db > solution.quality.psnr_db


@pytest.mark.parametrize("turns", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("uneven", [False, True])
def test_the_gray_level_is_the_one_whose_phase_is_nearest_on_the_circle(
    turns: float, sign: int, uneven: bool
) -> None:
    path = ideal_path((12, 16), 0.002)
    level = np.arange(256) / 256
    response = sign * 2 * np.pi * turns * (level + 0.2 * level * (1 - level)) + 0.3
    gain = 1 + 0.2 * np.random.default_rng(1).uniform(-1, 1, (12, 16)) if uneven else None
    path = replace(path, response=response, gain=gain)
    phase = np.random.default_rng(0).uniform(-20, 20, (12, 16))

    def away(shown: np.ndarray) -> np.ndarray:
        return np.abs(np.angle(np.exp(1j * (shown - phase))))

    every = np.stack([panel_phase(path, np.full((12, 16), g)) for g in range(256)])
    nearest = away(every).min(0)
    chosen = away(panel_phase(path, DriveRange(path).gray(phase).astype(int)))
    step = float(np.abs(np.diff(response)).max()) * (1.2 if uneven else 1)
    assert (chosen <= nearest + step).all()
    if turns <= 1:  # beyond a turn there are two candidates, and the one in reach without a turn is taken
        assert np.mean(chosen <= nearest + 1e-9) > 0.95


@pytest.mark.parametrize("penalty", ["amplitude", "irradiance", "l1"])
def test_a_long_descent_does_not_end_in_the_dark(penalty: str) -> None:
    """Light beside the iris leaves more freedom: without a limit the picture keeps a tenth of its light.

    Where a descent of one picture ends is decided by rounding (8.5 to 12 dB from its start), so four are asked.
    """
    shape, gained = (24, 32), []
    path = ideal_path(shape, 6e-3, 0.7, np.float32)
    for seed in range(4):
        first, last = (solve(path, scene(shape, seed), n, penalty=penalty) for n in (0, 1000))
        assert _light(path, last.gray) > 0.45 * _light(path, first.gray)
        gained.append(last.quality.psnr_db - first.quality.psnr_db)
    assert np.mean(gained) > 9


def test_a_picture_that_stays_does_not_end_in_the_dark() -> None:
    """Each frame goes on from the pattern of the one before."""
    shape = (24, 32)
    path, target = ideal_path(shape, 6e-3, 0.7, np.float32), scene(shape)
    solver = Solver(path)
    first, *_, last = (_light(path, solver.frame(target, 10).gray) for _ in range(100))
    assert last > 0.45 * first


def _light(path: LightPath, gray: np.ndarray) -> float:
    """Mean irradiance of a pattern on the picture."""
    return float(pixel_irradiance(path, irradiance(path, panel_phase(path, gray))).mean())


def test_a_start_may_be_given_and_progress_is_reported(ideal: LightPath) -> None:
    target = scene(SHAPE)
    first = solve(ideal, target, 15)
    reports: list[tuple[int, float]] = []
    again = solve(
        ideal, target, 5, start=first.phase, progress=lambda done, psnr: reports.append((done, psnr))
    )
    assert again.psnr_db[0] == pytest.approx(max(first.psnr_db), abs=1e-3)
    assert again.quality.psnr_db > first.quality.psnr_db
    assert [done for done, _ in reports] == list(range(6))
    assert [psnr for _, psnr in reports] == sorted(psnr for _, psnr in reports)


def test_everything_at_once_and_double_precision() -> None:
    for dtype in (np.float32, np.float64):
        path = random_path((40, 48), dtype=dtype, irradiance_filter=None)
        target = scene((40, 48))
        start, end = solve(path, target, 0).quality, solve(path, target, 20).quality
        assert end.psnr_db > start.psnr_db + 0.5
        assert solve(path, target, 2).phase.dtype == dtype


def test_quality_is_free_of_scale() -> None:
    target = scene((20, 30))
    assert quality(7 * target, target).psnr_db > 100
    assert quality(7 * target, target).nrmse < 1e-6
    assert quality(7 * target, target).scale == pytest.approx(7)
    noisy = target * np.random.default_rng(0).uniform(0.8, 1.2, target.shape)
    a, b = quality(noisy, target), quality(3 * noisy, target)
    assert a == Quality(pytest.approx(b.psnr_db), pytest.approx(b.nrmse), pytest.approx(b.scale / 3))
    assert quality(np.zeros_like(target), target).nrmse > 1


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (np.ones((96, 100)), r"the target is 96 x 100 \(height x width\) and the panel 96 x 128"),
        (np.ones((*SHAPE, 3)), "96 x 128 x 3"),
        (np.full(SHAPE, -1.0), "never below zero"),
        (np.full(SHAPE, np.nan), "non-finite"),
        (np.zeros(SHAPE), "all dark"),
        (np.full(SHAPE, 1e30), "brightest pixel is 1e.30"),
        (np.full(SHAPE, 1e-40), "brightest pixel is 1e-40"),
    ],
)
def test_targets_that_cannot_be_shown_are_refused(ideal: LightPath, target: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        solve(ideal, target, 1)


def test_counts_out_of_range_are_refused(ideal: LightPath) -> None:
    with pytest.raises(InputError, match="-1 iterations"):
        solve(ideal, scene(SHAPE), -1)
    for levels in (1, 257):
        with pytest.raises(InputError, match=f"{levels} gray levels: give from 2 to 256"):
            solve(ideal, scene(SHAPE), 1, levels=levels)


def test_a_flat_target_and_one_of_few_pixels_are_solved(ideal: LightPath) -> None:
    for target in (np.ones(SHAPE), np.eye(*SHAPE) * 1e-9, np.eye(*SHAPE, k=20) * 1e9):
        solution = solve(ideal, target, 3)
        assert np.isfinite(solution.phase).all()
        assert np.isfinite(solution.quality.psnr_db)


@pytest.mark.parametrize("seed", range(4))
def test_a_gradient_that_stays_to_the_last_bit_is_followed_and_no_error(seed: int) -> None:
    """A still picture is solved on and on, until its phase changes by less than single precision shows."""
    rng, shape = np.random.default_rng(seed), (1, 40, 48)
    far, near = (scale * rng.standard_normal(shape).astype(np.float32) for scale in (1, 0.1))
    gradients = iter((far, near, near))
    settled = SimpleNamespace(
        backend=Backend(1),
        light=far,
        shape=shape,
        strip=40,
        part=[np.empty(shape[1:], np.float32)],
        curvature=lambda colour: 3.0,
        gradient=lambda phase, out: np.copyto(out, next(gradients)),
    )
    method, phases = MemorylessBfgs(settled, [SimpleNamespace(bounded=False)]), np.zeros((4, *shape), "f4")
    for before, after in pairwise(phases):
        method.step(before, after)
    np.testing.assert_allclose(phases[3] - phases[2], -near / 3, rtol=1e-3, atol=1e-5)
