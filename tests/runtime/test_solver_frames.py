"""Several patterns for one picture: their mean light, their gradient, and a panel of few levels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath, irradiance, panel_phase, pixel_irradiance
from runtime.solver import DriveRange, Solver, quality, shown, solve
from runtime.solver.array_backend import Backend
from runtime.solver.objective import Objective
from runtime.solver.soft_levels import SHARPNESS, SoftLevels, distinct, levels_a_turn
from tests.runtime.benches import ideal_path, random_path, scene

SHAPE, DISTANCE = (64, 64), 0.01
SIXTEENTHS = 2 * np.pi * np.arange(16) / 16


@pytest.fixture(scope="module")
def ideal() -> LightPath:
    return ideal_path(SHAPE, DISTANCE, half_width=0.5, dtype=np.float32)


@pytest.fixture(scope="module")
def sixteen(ideal: LightPath) -> LightPath:
    return replace(ideal, response=SIXTEENTHS.astype(np.float32))


def mean_light(path: LightPath, gray: np.ndarray) -> np.ndarray:
    """The eye's mean of patterns [N, H, W], each propagated on its own."""
    each = [pixel_irradiance(path, irradiance(path, panel_phase(path, g.astype(int)))) for g in gray]
    return np.asarray(np.mean(each, axis=0))


def independent(path: LightPath, target: np.ndarray, frames: int, iterations: int) -> np.ndarray:
    """Patterns [N, H, W], each solved on its own from another start."""
    rng = np.random.default_rng(1)
    first = solve(path, target, 0).phase
    starts = [(first + rng.normal(scale=0.5, size=first.shape)).astype(np.float32) for _ in range(frames)]
    return np.stack([solve(path, target, iterations, start=s, grid="fine").gray for s in starts])


@pytest.mark.parametrize("levels", [256, 16])
def test_one_frame_is_the_solve_without_frames(ideal: LightPath, levels: int) -> None:
    path = replace(ideal, response=ideal.response[:: 256 // levels])
    target = scene(SHAPE)
    plain, one = Solver(path).solve(target, 6), Solver(path, frames=1).solve(target, 6)
    assert one.gray.shape == SHAPE
    np.testing.assert_array_equal(one.gray, plain.gray)
    assert one.psnr_db == plain.psnr_db
    if levels == 256:  # rounded at the end
        assert one.expected_psnr_db == max(one.psnr_db)
    else:  # in the loop
        assert one.expected_psnr_db == pytest.approx(one.quality.psnr_db, abs=0.2)
    np.testing.assert_array_equal(one.gray, DriveRange(path).gray(one.phase))


@pytest.mark.parametrize("iterations, ahead", [(1, -0.1), (20, 0.3), (60, 0.7)])
def test_few_levels_are_in_the_loop_of_one_pattern(
    ideal: LightPath, sixteen: LightPath, iterations: int, ahead: float
) -> None:
    """Against 256 levels' phase rounded at the end."""
    gains = []
    for seed in (0, 3, 5):
        target = scene(SHAPE, seed)
        after = DriveRange(sixteen).gray(solve(ideal, target, iterations).phase)
        rounded = quality(shown(sixteen, after), target).psnr_db
        gains.append(solve(sixteen, target, iterations).quality.psnr_db - rounded)
    assert np.mean(gains) > ahead


@pytest.mark.parametrize("iterations", [1, 20])
def test_a_still_picture_of_few_levels_never_gets_worse(sixteen: LightPath, iterations: int) -> None:
    target, solver = scene(SHAPE), Solver(sixteen)
    psnr, expected = [], []
    for _ in range(12):
        solution = solver.frame(target, iterations)
        psnr.append(solution.quality.psnr_db)
        expected.append(solution.expected_psnr_db)
    assert min(np.diff(expected)) > -1e-3
    assert min(np.diff(psnr)) > -0.1
    assert psnr[-1] > psnr[0] + 0.3


def test_a_descent_never_ends_below_its_start(sixteen: LightPath) -> None:
    target = scene(SHAPE)
    good = Solver(sixteen).solve(target, 60)
    for method, iterations in (("bfgs", 2), ("adam", 3)):
        again = Solver(sixteen, method=method).solve(target, iterations, start=good.phase)
        assert again.expected_psnr_db > good.expected_psnr_db - 1e-3
        assert again.quality.psnr_db > good.quality.psnr_db - 1e-3


def test_the_quality_is_that_of_the_mean_of_the_irradiances(ideal: LightPath) -> None:
    target = scene(SHAPE)
    solution = Solver(ideal, frames=3).solve(target, 5)
    assert solution.gray.shape == solution.phase.shape == (3, *SHAPE)
    assert quality(mean_light(ideal, solution.gray), target).psnr_db == pytest.approx(
        solution.quality.psnr_db, abs=1e-3
    )
    assert solution.expected_psnr_db == pytest.approx(solution.quality.psnr_db, abs=0.1)


@pytest.mark.parametrize("sharpness", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("fine", [False, True])
def test_the_gradient_of_the_joint_error_is_that_of_finite_differences(sharpness: float, fine: bool) -> None:
    path = random_path(crosstalk=None, modulation=None, irradiance_filter=None)
    path = replace(path, response=SIXTEENTHS)
    shape, frames = path.grid.shape, 2
    rng = np.random.default_rng(5)
    drives = [DriveRange(path)] * frames
    objective = Objective([[path]], fine, "amplitude", None, None, Backend(1), frames)
    if sharpness:
        objective.rounding = SoftLevels(drives, objective.shape, objective.strip, objective.backend)
        objective.rounding.sharpness = sharpness
    objective.aim(scene(shape)[None, None].astype(float) + 0.2)
    # Away from the levels themselves, where the slope of the soft rounding has a kink.
    step = 2 * np.pi / 16
    whole = rng.integers(2, 12, (frames, *shape))
    phase = (whole + rng.uniform(0.2, 0.8, (frames, *shape))) * step * path.gain
    gradient = np.zeros_like(phase)
    objective.look(phase)
    objective.gradient(phase, gradient)
    way = rng.normal(size=phase.shape)
    way[0] *= 0.3  # so that the frames count differently
    h = 1e-6
    ahead, behind = objective.look(phase + h * way), objective.look(phase - h * way)
    slope = (ahead - behind) / (2 * h) * objective.pixels
    assert float((gradient * way).sum()) == pytest.approx(slope, rel=1e-5)
    assert abs(slope) > 1e-2


def test_together_they_beat_one_and_as_many_on_their_own(ideal: LightPath) -> None:
    target = scene(SHAPE)
    together = Solver(ideal, frames=4).solve(target, 40)
    one = Solver(ideal, grid="fine").solve(target, 40)
    apart = quality(mean_light(ideal, independent(ideal, target, 4, 40)), target)
    assert together.quality.psnr_db > one.quality.psnr_db + 1.5
    assert together.quality.psnr_db > apart.psnr_db + 0.7


def test_dark_stays_dark(sixteen: LightPath) -> None:
    target = np.ones(SHAPE, np.float32)
    target[16:48, 20:44] = 0
    inside = (slice(20, 44), slice(24, 40))
    together = mean_light(sixteen, Solver(sixteen, frames=4).solve(target, 50).gray)
    apart = mean_light(sixteen, independent(sixteen, target, 4, 50))
    assert together[inside].mean() / together.mean() < 0.7 * apart[inside].mean() / apart.mean()


def test_few_levels_are_in_the_loop_and_all_that_is_written(ideal: LightPath, sixteen: LightPath) -> None:
    target = scene(SHAPE)
    solution = Solver(sixteen, frames=4).solve(target, 50)
    assert solution.gray.max() < 16
    assert solution.iterations == 50
    assert solution.expected_psnr_db == pytest.approx(solution.quality.psnr_db, abs=0.2)
    after = DriveRange(sixteen).gray(Solver(ideal, frames=4).solve(target, 50).phase)
    assert solution.quality.psnr_db > quality(shown(sixteen, after).mean(0), target).psnr_db + 1
    one = Solver(sixteen, grid="fine").solve(target, 50)
    assert solution.quality.psnr_db > one.quality.psnr_db + 2


def test_soft_levels_end_as_the_nearest_level(ideal: LightPath) -> None:
    rng = np.random.default_rng(2)
    uneven = np.sort(rng.uniform(0, 1.9 * np.pi, 12))
    gain = 1 + 0.02 * rng.uniform(-1, 1, SHAPE)
    for response, factor in (
        (SIXTEENTHS, None),
        (SIXTEENTHS[::-1] + 0.3, None),
        (uneven, None),
        (SIXTEENTHS, gain),
    ):
        path = replace(ideal, response=response, gain=factor)
        drive = DriveRange(path)
        soft = SoftLevels([drive], (1, *SHAPE), 16, Backend(2))
        low, high = drive.low, drive.high
        phase = low + (high - low) * rng.random((1, *SHAPE))  # uneven: beyond its ends there is a gap
        soft.sharpness = np.inf
        soft.round(phase)
        np.testing.assert_allclose(
            soft.phase[0], panel_phase(path, drive.gray(phase[0]).astype(int)), atol=1e-6
        )
        moved = []
        for sharpness in SHARPNESS:
            soft.sharpness = sharpness
            soft.round(phase)
            moved.append(float(np.abs(soft.phase - phase).mean()))
            assert (soft.slope > 0).all()
        assert moved == sorted(moved)
        assert moved[0] < 0.1 * 2 * np.pi / 12


def test_the_levels_of_a_turn_are_counted(ideal: LightPath) -> None:
    level = np.arange(256)
    for response, count in (
        (2 * np.pi * level / 256, 256),
        (2 * np.pi * level / 16, 16),  # sixteen turns
        (2 * np.pi * (level // 16) / 16, 16),  # a staircase
        (-2 * np.pi * (level // 8) / 32, 32),
    ):
        assert levels_a_turn(DriveRange(replace(ideal, response=response))) == count
    assert len(distinct(np.array([0.0, 0.0, 1.0, 1.0, 2.0]))) == 3


def test_colours_planes_a_deadline_and_a_video(ideal: LightPath, sixteen: LightPath) -> None:
    target = scene(SHAPE)
    two = Solver([sixteen, sixteen], frames=2).solve(np.stack([target, target[::-1]]), 10)
    assert two.gray.shape == (2, 2, *SHAPE)
    assert len(two.qualities) == 2
    for gray, seen, wanted in zip(two.gray, two.qualities, (target, target[::-1]), strict=True):
        assert quality(mean_light(sixteen, gray), wanted).psnr_db == pytest.approx(seen.psnr_db, abs=1e-3)
    planes = Solver([[ideal, ideal]], frames=2).solve(target, 3)
    assert planes.gray.shape == (2, *SHAPE)
    solver = Solver(sixteen, frames=2)
    assert solver.solve(target, deadline_ms=400).milliseconds < 600
    solver.frame(target, 20)
    after = np.roll(target, 3, 1)
    moved, cold = solver.frame(after, 10), Solver(sixteen, frames=2).solve(after, 10)
    assert moved.quality.psnr_db > cold.quality.psnr_db - 0.3


@pytest.mark.parametrize("frames", [2, 4, 8, 9])
def test_patterns_that_are_needed_at_once_are_no_worse_than_one_and_differ(
    ideal: LightPath, frames: int
) -> None:
    target = scene(SHAPE)
    one = Solver(ideal, grid="panel").frame(target, 0).quality.psnr_db
    solver = Solver(ideal, frames=frames, grid="panel")
    made = solver.frame(target, 0)
    assert len({gray.tobytes() for gray in made.gray}) == frames
    assert made.quality.psnr_db > one - (0.2 if frames <= 8 else 2)  # the ninth has noise
    assert Solver(ideal, frames=frames, grid="panel").solve(target, 0).quality.psnr_db < one - 2
    assert solver.frame(target, 10).quality.psnr_db > made.quality.psnr_db + 1, "they part"


@pytest.mark.parametrize("frames", [0, -1, 33])
def test_a_number_of_frames_out_of_range_is_refused(ideal: LightPath, frames: int) -> None:
    with pytest.raises(InputError, match=f"{frames} frames a picture: give from 1 to 32"):
        Solver(ideal, frames=frames)


@pytest.mark.parametrize("method", ["gerchberg_saxton", "double_phase"])
def test_methods_of_one_pattern_say_so(ideal: LightPath, method: str) -> None:
    with pytest.raises(InputError, match="one pattern a picture: use bfgs or adam"):
        Solver(ideal, method=method, frames=2)
