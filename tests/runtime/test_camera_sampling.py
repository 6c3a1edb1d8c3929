"""One camera for the trainer and the headset: band extension, splines and pixel area against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from runtime.camera.sampling import (
    finer_picture,
    finer_picture_adjoint,
    pixel_area,
    rectified,
    registered_samples,
    spline_filter,
    spline_matrix,
    spline_samples,
)
from runtime.camera.view import View, sampler_and_adjoint
from runtime.lightpath.fft import irfft, irfft2, rfft2
from runtime.lightpath.grid import FINE, at_pixels, grid_for
from tests.runtime.benches import ideal_path

SIZES = [(32, 40), (31, 40), (32, 41), (31, 41)]  # even and odd, rows and columns


@pytest.fixture(params=["numpy", "torch"])
def as_array(request: pytest.FixtureRequest) -> Callable[[np.ndarray], Any]:
    """Puts a NumPy array into the library under test."""
    if request.param == "numpy":
        return np.asarray
    return pytest.importorskip("torch").as_tensor  # type: ignore[no-any-return]


def waves(size: tuple[int, int], y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A picture of period `size`, in samples, at places: waves of up to a quarter of a cycle a sample."""
    turns = (2 * np.pi * y / size[0], 2 * np.pi * x / size[1])
    rows, columns = (n // 4 for n in size)
    return np.asarray(
        1
        + 0.5 * np.cos(rows * turns[0] - 3 * turns[1])
        + 0.4 * np.sin(2 * turns[0] + columns * turns[1])
        + 0.3 * np.cos(5 * turns[0] + 0.7)
    )


def frequencies(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Of `rfft2` of a picture of the light path's fine grid, cycles a panel pixel."""
    return FINE * np.fft.fftfreq(size[0])[:, None], FINE * np.fft.rfftfreq(size[1])[None, :]


def coefficients(picture: np.ndarray, finer: int, as_array: Callable[[np.ndarray], Any]) -> Any:
    """Splines' coefficients of a picture [n, m] on a grid `finer` times as fine."""
    iy, ix = (as_array(f) for f in frequencies(picture.shape))  # type: ignore[arg-type]
    spectrum = rfft2(as_array(picture)) / spline_filter(iy, ix, FINE * finer)
    return finer_picture(spectrum, picture.shape, finer)  # type: ignore[arg-type]


@pytest.mark.parametrize("half_width", [1.0, 1.5])
@pytest.mark.parametrize("shape", [(20, 24), (21, 25), (20, 25)])
def test_samples_at_the_panels_pixels_are_those_of_the_whole_picture(
    shape: tuple[int, int], half_width: float, as_array: Callable[[np.ndarray], Any]
) -> None:
    grid = grid_for(shape, 8e-6, 520e-9, 1e-3, half_width, margin=6)
    picture = np.random.default_rng(0).normal(size=(2, *grid.image_shape))
    shift = np.exp(
        -2j * np.pi * 0.3 * np.fft.rfftfreq(grid.image_shape[1])
    )  # not symmetric: a displaced picture
    spectrum = np.fft.rfft2(picture) * shift
    expected = at_pixels(grid, np.fft.irfft2(spectrum, s=grid.image_shape))
    np.testing.assert_allclose(np.asarray(registered_samples(grid, as_array(spectrum))), expected, atol=1e-12)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("finer", [1, 2, 3])
def test_a_finer_picture_has_the_same_waves(
    size: tuple[int, int], finer: int, as_array: Callable[[np.ndarray], Any]
) -> None:
    picture = waves(size, *np.mgrid[: size[0], : size[1]])
    fine = finer_picture(rfft2(as_array(picture)), size, finer)
    y, x = np.mgrid[: finer * size[0], : finer * size[1]] / finer
    np.testing.assert_allclose(np.asarray(fine), waves(size, y, x), atol=1e-12)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("finer", [1, 2, 3])
def test_a_finer_picture_has_its_adjoint(size: tuple[int, int], finer: int) -> None:
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=size), rng.normal(size=(finer * size[0], finer * size[1]))
    there = finer_picture(rfft2(one), size, finer)
    back = irfft2(finer_picture_adjoint(rfft2(other), size), size)
    assert np.vdot(there, other) == pytest.approx(np.vdot(one, back), rel=1e-12)


@pytest.mark.parametrize("panel", [(40, 52), (39, 52), (40, 51), (39, 51)])
@pytest.mark.parametrize("finer", [1, 2])
def test_a_camera_has_its_adjoint_for_even_and_odd_panels(panel: tuple[int, int], finer: int) -> None:
    grid = ideal_path(panel, 8e-3).grid
    turned = (0.9, 0.05, 2.0, -0.05, 0.9, 3.0, 0, 0, 1)
    sampled, adjoint = sampler_and_adjoint(View((33, 44), turned, blur_x_px2=0.2), grid, finer)
    rng = np.random.default_rng(1)
    image, light = rng.normal(size=grid.image_shape), rng.normal(size=(33, 44))
    there, back = np.vdot(sampled(image), light), np.vdot(image, adjoint(light))
    scale = np.linalg.norm(sampled(image)) * np.linalg.norm(light)
    assert abs(there - back) < 1e-6 * scale  # the weights are in single precision


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("finer", "tolerance"), [(1, 3e-2), (2, 2e-3), (4, 1e-4)])
def test_splines_read_a_band_limited_picture_between_its_samples(
    size: tuple[int, int], finer: int, tolerance: float, as_array: Callable[[np.ndarray], Any]
) -> None:
    rng = np.random.default_rng(2)
    y, x = (rng.uniform(2, n - 3, (17, 19)) for n in size)
    splines = coefficients(waves(size, *np.mgrid[: size[0], : size[1]]), finer, as_array)
    read = np.asarray(spline_samples(splines, as_array(finer * y), as_array(finer * x)))
    np.testing.assert_allclose(read, waves(size, y, x), atol=tolerance)


def test_splines_pass_through_the_samples_and_are_the_matrix() -> None:
    size = (31, 40)
    picture = waves(size, *np.mgrid[: size[0], : size[1]])
    splines = coefficients(picture, 1, np.asarray)
    y, x = (a.astype(float) for a in np.mgrid[2:28, 2:37])
    read = spline_samples(splines, y, x)
    np.testing.assert_allclose(read, picture[2:28, 2:37], atol=1e-12)
    y, x = y + 0.3, x - 0.6
    matrix = spline_matrix(y, x, size)
    np.testing.assert_allclose(
        (matrix @ splines.ravel()).reshape(y.shape), spline_samples(splines, y, x), atol=1e-6
    )


def test_both_libraries_read_the_same() -> None:
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(3)
    picture, size = rng.normal(size=(32, 41)), (32, 41)
    y, x = (rng.uniform(-4, 2 * n + 4, (23, 29)) for n in size)
    one = spline_samples(coefficients(picture, 2, np.asarray), y, x)
    other = spline_samples(coefficients(picture, 2, torch.as_tensor), torch.as_tensor(y), torch.as_tensor(x))
    np.testing.assert_allclose(other.numpy(), one, atol=1e-12)


@pytest.mark.parametrize("place", [-30.0, -0.01, 0.99, 30.0, 31.5, 500.0])
def test_a_pixel_beyond_the_grid_reads_0(place: float, as_array: Callable[[np.ndarray], Any]) -> None:
    bright = np.full((32, 40), 7.0)
    y, x = np.array([[place, 15.0]]), np.array([[20.0, place if place < 30 else place + 8]])
    read = np.asarray(spline_samples(as_array(bright), as_array(y), as_array(x)))
    assert read.tolist() == [[0.0, 0.0]]
    assert not (spline_matrix(y, x, (32, 40)) @ bright.ravel()).any()
    inside = np.asarray(spline_samples(as_array(bright), as_array(y * 0 + 15), as_array(x * 0 + 20)))
    np.testing.assert_allclose(inside, 7.0)


def test_pixel_area_is_the_mean_of_a_wave_over_the_pixels_parallelogram(
    as_array: Callable[[np.ndarray], Any],
) -> None:
    sides = np.array([[0.7, 0.15], [-0.2, 1.3]])  # down and right on the camera, as (y, x) on the panel
    rows, columns = np.mgrid[:9, :12]
    y, x = (sides[0, k] * rows + sides[1, k] * columns + 3 for k in (0, 1))
    iy, ix = np.linspace(-0.9, 0.9, 7)[:, None], np.linspace(0, 0.9, 5)[None, :]
    nodes, weights = np.polynomial.legendre.leggauss(12)
    v, u = nodes[:, None] / 2, nodes[None, :] / 2  # of a pixel's side, from its centre
    over_y, over_x = (sides[0, k] * v + sides[1, k] * u for k in (0, 1))
    each = weights[:, None] * weights[None, :] / 4
    wave = np.exp(2j * np.pi * (iy[..., None, None] * over_y + ix[..., None, None] * over_x))
    area = np.asarray(pixel_area(*(as_array(a.astype(float)) for a in (iy, ix, y, x))))
    np.testing.assert_allclose(area, (wave * each).sum((-2, -1)), atol=1e-12)


def test_a_rectified_picture_is_read_at_places_and_0_outside() -> None:
    y, x = np.mgrid[:60, :80]
    picture = np.sin(y / 6.0) + np.cos(x / 7.0)
    v, u = (np.random.default_rng(4).uniform(8, n - 9, (11, 13)) for n in picture.shape)
    np.testing.assert_allclose(rectified(picture, v, u), np.sin(v / 6) + np.cos(u / 7), atol=1e-3)
    outside = rectified(np.ones((6, 8)), np.array([-0.1, 5.1, 3.0]), np.array([4.0, 4.0, 7.1]))
    assert outside.tolist() == [0, 0, 0]
    for kind, result in ((np.uint16, np.float32), (np.float32, np.float32), (np.float64, np.float64)):
        counts = (100 * picture + 200).astype(kind)
        read = rectified(counts, v, u)
        assert read.dtype == result
        np.testing.assert_allclose(read, 200 + 100 * (np.sin(v / 6) + np.cos(u / 7)), atol=2)


@pytest.mark.parametrize("rows", [1, 32, 75])
@pytest.mark.parametrize("kept", [20, 33])
def test_rows_of_half_a_spectrum_are_transformed_with_the_rest_zero(rows: int, kept: int) -> None:
    """However many rows are worked on at a time, none takes anything from the ones before."""
    generator = np.random.default_rng(rows)
    half = generator.normal(size=(2, rows, kept)) + 1j * generator.normal(size=(2, rows, kept))
    before = half.copy()
    np.testing.assert_allclose(irfft(half, 64), np.fft.irfft(half, 64), rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(half, before)
