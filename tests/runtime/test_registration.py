"""A homography is found to a tenth of a pixel from a noisy picture of dots, or refused with a reason."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_iface.errors import InputError
from runtime.camera.registration import (
    BROAD,
    SPREAD,
    Dots,
    dot_pattern,
    dots_of,
    find_homography,
    panel_points,
)
from runtime.camera.sampling import panel_on_camera, rectified

SHAPE = (200, 280)


def camera_to_panel(
    scale: float, degrees: float, mirrored: bool, tilt: float
) -> tuple[np.ndarray, tuple[int, int]]:
    """A homography, and the shape (height, width) of a camera that sees the whole panel."""
    height, width = int(SHAPE[0] * scale * 1.35) + 16, int(SHAPE[1] * scale * 1.35) + 16
    a = np.deg2rad(degrees)
    turn = scale * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    turn = turn @ np.diag([-1 if mirrored else 1, 1])
    to_camera = np.eye(3)
    to_camera[:2, :2] = turn
    to_camera[:2, 2] = (width / 2 + 1.3, height / 2 - 2.7) - turn @ ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    to_camera = np.array([[1, 0, 0], [0, 1, 0], [tilt / scale, -tilt / scale / 2, 1]]) @ to_camera
    matrix = np.linalg.inv(to_camera)
    return matrix / matrix[2, 2], (height, width)


def picture(dots: Dots, matrix: np.ndarray, shape: tuple[int, int], noise: float = 4.0) -> np.ndarray:
    """Counts of a camera that sees the dots, each pixel of 3 x 3 samples, with uneven light and noise."""
    fine = 3
    light = np.zeros((shape[0] * fine, shape[1] * fine))
    centres = panel_points(np.linalg.inv(matrix), dots.xy)
    for number, (centre, dot) in enumerate(zip(centres, dots.xy, strict=True)):
        sigma = SPREAD * dots.spacing * (BROAD[number] if number < 2 else 1)
        edge = panel_points(np.linalg.inv(matrix), dot[None] + (6 * sigma, 0))[0]
        reach = float(np.hypot(*(edge - centre)))
        rows, columns = (
            slice(max(int((c - reach) * fine), 0), max(int((c + reach) * fine) + 1, 0))
            for c in (centre[1], centre[0])
        )
        y, x = np.meshgrid(np.arange(light.shape[0])[rows], np.arange(light.shape[1])[columns], indexing="ij")
        camera = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], 1) / fine - 0.5
        square = ((panel_points(matrix, camera) - dot) ** 2).sum(1).reshape(x.shape)
        light[rows, columns] = np.maximum(light[rows, columns], np.exp(-square / (2 * sigma**2)))
    light = light.reshape(shape[0], fine, shape[1], fine).mean((1, 3))
    rng = np.random.default_rng(0)
    counts = 64 + 1500 * light * np.linspace(0.6, 1, shape[1]) + 40 * np.linspace(0, 1, shape[0])[:, None]
    return np.clip(rng.poisson(counts / 0.4) * 0.4 + rng.normal(0, noise, shape), 0, 4095).astype(np.uint16)


def worst(found: np.ndarray, truth: np.ndarray, dots: Dots) -> float:
    """The largest error over the area of the dots, panel pixels."""
    camera = panel_points(np.linalg.inv(truth), dots.xy)
    return float(np.hypot(*(panel_points(found, camera) - dots.xy).T).max())


@pytest.mark.parametrize(
    ("scale", "degrees", "mirrored", "tilt"),
    [
        (1.0, 0.0, False, 0.0),
        (1.0, 5.0, True, 1e-4),
        (0.5, -7.0, False, 1e-4),
        (0.3, 3.0, True, 0.0),
        (0.3, -4.0, False, 1e-4),
        (2.0, 8.0, True, 1e-4),
        (3.0, -3.0, False, 1e-4),
        (0.7, 180.0, False, 0.0),
    ],
)
def test_homography_is_found(scale: float, degrees: float, mirrored: bool, tilt: float) -> None:
    dots = dots_of(SHAPE, 30)
    truth, shape = camera_to_panel(scale, degrees, mirrored, tilt)
    found = find_homography(picture(dots, truth, shape), dots)
    assert found[2, 2] == 1 and worst(found, truth, dots) < 0.1


def test_noise_hot_pixels_and_lost_dots_do_no_harm() -> None:
    dots = dots_of(SHAPE, 24)
    truth, shape = camera_to_panel(1.3, 4, True, 1e-4)
    seen = picture(dots, truth, shape, noise=40)
    rng = np.random.default_rng(1)
    seen[rng.integers(0, shape[0], 60), rng.integers(0, shape[1], 60)] = 4095
    x, y = panel_points(np.linalg.inv(truth), dots.xy[40:41])[0].astype(int)
    seen[y - 14 : y + 14, x - 14 : x + 14] = 64
    assert worst(find_homography(seen, dots), truth, dots) < 0.15


def test_pattern_is_dots_on_black() -> None:
    target = dot_pattern(SHAPE, 25)
    dots = dots_of(SHAPE, 25)
    assert target.shape == SHAPE and target.dtype == np.float32 and target.min() >= 0 and target.max() <= 1
    assert len(dots.xy) == dots.rows * dots.columns
    assert all(target[round(y), round(x)] > 0.9 for x, y in dots.xy)
    assert float(target.mean()) < 0.15
    for turned in (target[:, ::-1], target[::-1], target[::-1, ::-1]):
        assert not np.allclose(target, turned)
    for spacing in (4, 80, float("nan"), -3):
        with pytest.raises(InputError, match="spacing"):
            dots_of(SHAPE, spacing)


def test_pictures_without_the_pattern_are_refused() -> None:
    dots = dots_of(SHAPE, 30)
    truth, shape = camera_to_panel(1.0, 0, False, 0)
    dark = np.random.default_rng(0).poisson(64, shape).astype(np.uint16)
    seen = picture(dots, truth, shape)
    for wrong in (dark, np.zeros(shape), seen[:, shape[1] // 2 :], np.full(shape, np.nan)):
        with pytest.raises(InputError, match="dots"):
            find_homography(wrong, dots)
    x, y = panel_points(np.linalg.inv(truth), dots.xy[:1])[0].astype(int)
    seen[y - 15 : y + 16, x - 15 : x + 16] = 64
    with pytest.raises(InputError, match="marker"):
        find_homography(seen, dots)
    with pytest.raises(InputError, match="16 x 16"):
        find_homography(np.zeros((3, 4, 3)), dots)


def test_resampling_puts_the_dots_where_the_panel_has_them() -> None:
    dots = dots_of(SHAPE, 30)
    truth, shape = camera_to_panel(1.5, 5, True, 1e-4)
    straight = rectified(picture(dots, truth, shape, noise=0), *panel_on_camera(truth, SHAPE))
    assert straight.shape == SHAPE and straight.dtype == np.float32
    centre = straight[20:-20, 20:-20].ravel()
    assert np.corrcoef(centre, dot_pattern(SHAPE, 30)[20:-20, 20:-20].ravel())[0, 1] > 0.97
