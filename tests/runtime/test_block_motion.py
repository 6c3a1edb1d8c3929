"""A video in which things move by themselves: the motion of each block, and patterns that follow it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from runtime.solver import Solver, quality, shown
from runtime.solver.block_motion import BLOCK, Part, block_motions, follow
from runtime.solver.chosen_backend import backend
from runtime.solver.video_motion import motion_between
from tests.runtime.benches import ideal_path

SHAPE = (160, 224)
HOST = backend("numpy")
Motion = tuple[int, int]


def texture(seed: int, shape: tuple[int, int]) -> np.ndarray:
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 3)
    return (0.05 + 0.9 * (noise - noise.min()) / np.ptp(noise)).astype(np.float32)


def video(background: Motion, thing: Motion, frames: int) -> Iterator[np.ndarray]:
    """A textured background, and in front of it a textured square of 64 pixels, each with a motion of its own."""
    wide, square = texture(0, (400, 500)), texture(1, (64, 64))
    for k in range(frames):
        y, x = 100 - k * background[0], 120 - k * background[1]
        frame = wide[y : y + SHAPE[0], x : x + SHAPE[1]].copy()
        y, x = 48 + k * thing[0], 40 + k * thing[1]
        frame[y : y + 64, x : x + 64] = square
        yield frame


def motion_map(parts: list[Part], whole: Motion) -> np.ndarray:
    """Motion of each pixel, [H, W, 2]; NaN where content is new."""
    found = np.empty((*SHAPE, 2))
    found[:] = whole
    for part in parts:
        found[part.rows, part.columns] = np.nan if part.motion is None else part.motion
    return found


@pytest.mark.parametrize(("background", "thing"), [((0, 0), (2, 5)), ((1, -3), (2, 5)), ((-2, 1), (0, 0))])
def test_each_block_is_found_to_move_as_it_does(background: Motion, thing: Motion) -> None:
    before, after = video(background, thing, 2)
    whole, parts = block_motions(before, after, motion_between(before, after), HOST)
    assert whole == background
    found = motion_map(parts, whole)
    square = (slice(48 + BLOCK, 48 + 64 - BLOCK), slice(40 + BLOCK, 40 + 64 - BLOCK))
    assert (found[square] == thing).all()
    away = found[:, 40 + 64 + 2 * BLOCK :]
    assert np.mean((away == background).all(-1)) > 0.95
    assert np.nanmean(np.abs(np.subtract(found, background)).sum(-1) > 0) < 0.3


def test_a_picture_that_moves_as_a_whole_has_no_parts() -> None:
    before, after = (texture(0, (400, 500))[100 - k : 260 - k, 120 - 3 * k : 344 - 3 * k] for k in (0, 1))
    assert block_motions(before, after, (1, 3), HOST) == ((1, 3), [])
    assert block_motions(before, before, (0, 0), HOST) == ((0, 0), [])


def test_what_was_not_there_is_new() -> None:
    before = texture(0, SHAPE)
    after = before.copy()
    after[64:96, 96:144] = texture(5, (32, 48))[::-1]
    whole, parts = block_motions(before, after, (0, 0), HOST)
    new = np.isnan(motion_map(parts, whole)[..., 0])
    assert whole == (0, 0) and new[64:96, 96:144].mean() > 0.6 and new.sum() <= 32 * 48


def test_what_was_found_follows_a_part_by_even_numbers_and_where_it_was_before() -> None:
    found, fresh = np.random.default_rng(3).random((2, 40, 50))
    phase = np.zeros((40, 50))
    follow(phase, found, fresh, Part(slice(0, 16), slice(32, 50), (5, -3)), (0, 0))
    np.testing.assert_array_equal(phase[5:16, 32:47], fresh[5:16, 32:47] + found[0:11, 35:50])
    np.testing.assert_array_equal(phase[:5, 32:], fresh[:5, 32:])
    np.testing.assert_array_equal(phase[5:16, 47:], fresh[5:16, 47:])
    assert not phase[16:].any() and not phase[:, :32].any()
    for motion in ((40, 0), (2, 1), None):  # from beyond the panel, off the chequerboard, new
        follow(phase, found, fresh, Part(slice(16, 32), slice(0, 16), motion), (0, 0))
        np.testing.assert_array_equal(phase[16:32, :16], fresh[16:32, :16])
    # the chequerboard of the start has moved with the whole
    follow(phase, found, fresh, Part(slice(16, 32), slice(4, 16), (2, 1)), (1, 0))
    np.testing.assert_array_equal(phase[16:32, 4:16], fresh[16:32, 4:16] + found[14:30, 3:15])


@pytest.mark.parametrize(("background", "thing"), [((0, 0), (2, 5)), ((1, -3), (2, 4))])
def test_patterns_of_a_moving_thing_are_as_good_as_new_ones(background: Motion, thing: Motion) -> None:
    """One iteration a frame. Moved as a whole, patterns are 5 to 9 dB behind those that begin anew."""
    path = ideal_path(SHAPE, 8e-3, 0.5, np.float32)
    warm, inside = Solver(path, grid="panel"), (slice(8, -8), slice(8, -8))
    followed, anew = [], []
    for frame in video(background, thing, 12):
        light = shown(path, warm.frame(frame, 1).gray)
        followed.append(quality(light[inside], frame[inside]).psnr_db)
        light = shown(path, Solver(path, grid="panel").solve(frame, 1).gray)
        anew.append(quality(light[inside], frame[inside]).psnr_db)
    assert np.mean(followed[4:]) > np.mean(anew[4:]) - 1
