"""Video: a frame begins with the pattern of the frame before, moved as its content has moved."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.lightpath.light_path import LightPath
from runtime.solver import Solver, motion_between, solve
from tests.runtime.benches import ideal_path, scene

SHAPE, DISTANCE = (96, 128), 0.015


@pytest.fixture(scope="module")
def half() -> LightPath:
    """A path whose iris passes half of the panel's band, so that once a pixel is exact."""
    return ideal_path(SHAPE, DISTANCE, 0.5, np.float32)


def test_video_begins_with_the_frame_before_moved() -> None:
    """Content that moves by whole pixels: one warm iteration is near ten cold ones, unmoved it is not."""
    shape = (160, 200)
    path = ideal_path(shape, 0.01, 0.5, np.float32)
    whole = scene((shape[0] + 40, shape[1] + 40), 7)

    def frame(k: int) -> np.ndarray:
        return np.ascontiguousarray(whole[2 * k : 2 * k + shape[0], 3 * k : 3 * k + shape[1]])

    region = np.zeros(shape)
    region[30:-30, 30:-30] = 1
    solver, still = Solver(path, region=region), Solver(path, region=region)
    solver.frame(frame(0), 15)
    phase = still.solve(frame(0), 15).phase
    for k in range(1, 5):
        warm = solver.frame(frame(k), 1)
        unmoved = still.solve(frame(k), 1, start=phase)
        phase = unmoved.phase
        cold = Solver(path, region=region).frame(frame(k), 10)
        assert warm.iterations == 1
        assert warm.quality.psnr_db > cold.quality.psnr_db - 2
        assert warm.quality.psnr_db > unmoved.quality.psnr_db + 3


def test_a_long_pan_does_not_decay() -> None:
    """One iteration a frame: within 1 dB of ten cold ones inside a border, better than two cold ones to the edge."""
    shape = (160, 200)
    path = ideal_path(shape, 0.01, 0.5, np.float32)
    whole = scene((shape[0] + 40, shape[1] + 60), 7)

    def frame(k: int) -> np.ndarray:
        return np.ascontiguousarray(whole[k : k + shape[0], 2 * k : 2 * k + shape[1]])

    region = np.zeros(shape)
    region[30:-30, 30:-30] = 1
    for weight, cold_iterations, within in ((region, 10, 1.0), (None, 2, 0.0)):
        solver = Solver(path, region=weight)
        solver.frame(frame(0), 10)
        for k in range(1, 25):
            warm = solver.frame(frame(k), 1)
        cold = Solver(path, region=weight).frame(frame(24), cold_iterations)
        assert warm.quality.psnr_db > cold.quality.psnr_db - within


def test_a_dark_background_stays_dark_while_it_moves() -> None:
    """The phase of double phase means nothing in the dark; taken for that of the frame before, the dark lights up."""
    shape = (270, 480)
    path = ideal_path(shape, 0.0075, 0.5, np.float32)
    whole = scene((shape[0] + 10, shape[1] + 30), 7)
    whole *= 1 / (1 + np.exp((np.arange(whole.shape[1]) - 0.6 * whole.shape[1]) / 6))

    def frame(k: int) -> np.ndarray:
        return np.ascontiguousarray(whole[k : k + shape[0], 3 * k : 3 * k + shape[1]])

    solver = Solver(path)
    solver.frame(frame(0), 10)
    warm = [solver.frame(frame(k), 1).quality.psnr_db for k in range(1, 9)]
    assert min(warm) > Solver(path).frame(frame(8), 2).quality.psnr_db


@pytest.mark.parametrize("between", ["another picture", "another picture, still", "rehearsal"])
def test_the_edges_of_a_pan_keep_nothing_of_another_picture(between: str) -> None:
    """What the edges' patterns are over their start holds for the picture that both were made for."""
    shape = (160, 200)
    path = ideal_path(shape, 0.01, 0.5, np.float32)
    solver, moved = Solver(path), (2, 3)
    now = scene(shape, 7)
    solver.frame(now, 10)
    if between == "rehearsal":
        solver.rehearse()
    else:
        now = now**2 if between.endswith("still") else scene(shape, 3)
        if between.endswith("still"):
            solver.frame(now, 5, motion=(0, 0))
        else:
            solver.solve(now, 5, start=solve(path, now, 0).phase)
    after = np.roll(now, moved, (0, 1))
    warm = solver.frame(after, 1, motion=moved)
    assert warm.quality.psnr_db > Solver(path).frame(after, 1).quality.psnr_db - 0.5


def test_motion_is_found_and_a_cut_begins_cold(half: LightPath) -> None:
    whole = scene((160, 200), 3)
    before, after = whole[20:116, 30:158], whole[13:109, 35:163]
    assert motion_between(before, after) == (7, -5)
    solver = Solver(half)
    solver.frame(scene(SHAPE, 0), 8)
    other = 1 - scene(SHAPE, 0)[::-1, ::-1]
    np.testing.assert_allclose(
        solver.frame(other, 2).psnr_db, Solver(half).frame(other, 2).psnr_db, atol=1e-3
    )


def test_motion_is_found_whichever_colour_is_dark(half: LightPath) -> None:
    whole, dark = scene((160, 200), 3), np.full(SHAPE, 1e-3)
    before, after = whole[20:116, 30:158], whole[16:112, 32:160]
    found = []
    for place in (0, 1):
        solver = Solver([half, half])
        solver.frame(np.insert(before[None], place, dark, 0), 10)
        found.append(solver.frame(np.insert(after[None], place, dark, 0), 1).psnr_db)
    np.testing.assert_allclose(*found, atol=1e-3)


def test_a_rehearsal_in_the_middle_of_a_video_changes_nothing(half: LightPath) -> None:
    one, other = Solver(half), Solver(half)
    for solver in (one, other):
        solver.frame(scene(SHAPE, 0), 5)
    other.rehearse()
    assert other.objective.least == one.objective.least, "what light the pictures have to keep"
    a, b = (s.frame(scene(SHAPE, 0), 1, motion=(0, 0)).psnr_db for s in (one, other))
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_double_phase_moves_with_its_chequerboard() -> None:
    """Content that moves by an odd number, on the chequerboard moved as far, keeps its pattern; on the old one not."""
    shape, motion = (160, 200), (1, 2)
    start = Solver(ideal_path(shape, 0.03, 0.5, np.float32)).first.starts[0]
    start.tilt(moves=True)
    assert not any(turned.any() for turned in start.light.turned)
    whole = np.sqrt(scene((shape[0] + 10, shape[1] + 10), 7)).astype(np.float32)
    before, after, old = (np.zeros(shape, np.float32) for _ in range(3))
    start.double_phase(np.ascontiguousarray(whole[1 : 1 + shape[0], 2 : 2 + shape[1]]), before)
    start.double_phase(np.ascontiguousarray(whole[: shape[0], : shape[1]]), after, moved=motion)
    start.double_phase(np.ascontiguousarray(whole[: shape[0], : shape[1]]), old)
    inside = slice(60, -60), slice(60, -60)
    wanted = np.roll(before, motion, (0, 1))[inside]
    error, wrong = (np.abs(np.exp(1j * (x[inside] - wanted)) - 1).mean() for x in (after, old))
    assert error < 0.1 * wrong


def test_a_still_picture_gains_from_a_tilt_that_rises_fast() -> None:
    """At a distance at which the frames of a video have a flat image, a still picture has detail of one side more."""
    path, picture = ideal_path((160, 200), 0.01, 0.5, np.float32), scene((160, 200), 7)
    still, flat = Solver(path), Solver(path)
    assert still.solve(picture, 5).quality.psnr_db > flat.frame(picture, 5).quality.psnr_db + 0.5
