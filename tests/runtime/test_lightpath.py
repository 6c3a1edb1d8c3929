"""The light path against independent optics, its own adjoint, and itself in another precision and library."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from firmware_iface.virtual import VirtualHeadset, load_bench
from firmware_iface.virtual.bench_description import IrisDescription
from runtime.camera.sampling import finer_picture
from runtime.lightpath.crosstalk import mix_neighbours
from runtime.lightpath.grid import FINE, at_pixels, grid_for
from runtime.lightpath.light_path import (
    LightPath,
    image_field,
    irradiance,
    mode_irradiance,
    panel_phase,
    panel_spectrum,
    pixel_irradiance,
)
from runtime.lightpath.light_path_adjoint import irradiance_and_pullback, pixel_irradiance_adjoint
from runtime.lightpath.periodic_axis import put, ring, take
from tests.runtime.benches import (
    PATHS,
    PITCH,
    converted,
    ideal_path,
    padded_irradiance,
    random_path,
    torch_path,
)

torch = pytest.importorskip("torch")


def phases(path: LightPath, *batch: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 2, (*batch, *path.grid.shape))


def phase_gradient(path: LightPath, phase: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Gradient of a loss over phase, from its gradient over irradiance."""
    return irradiance_and_pullback(path, phase)[1](gradient)


def close(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference over the largest value."""
    return float(np.abs(np.asarray(a) - np.asarray(b)).max() / np.abs(np.asarray(b)).max())


def relative(a: np.ndarray, b: np.ndarray) -> float:
    """Root of the summed squared difference over that of the values."""
    return float(np.linalg.norm(np.asarray(a) - np.asarray(b)) / np.linalg.norm(np.asarray(b)))


@pytest.mark.parametrize("distance", [0.004, 0.012, 0.03])
@pytest.mark.parametrize(("grain", "most"), [(0.0, 3e-3), (1.5, 1e-4)])
def test_agrees_with_a_padded_propagation_of_the_panel_drawn_on_subpixels(
    distance: float, grain: float, most: float
) -> None:
    """Share of the variance that differs; where light fills the band, a bin of the iris's edge counts in it."""
    path = ideal_path((48, 64), distance)
    phase = gaussian_filter(np.random.default_rng(5).normal(size=(48, 64)), grain)
    phase *= 2 / phase.std()
    expected = padded_irradiance(phase, distance, pad=5)
    seen = pixel_irradiance(path, irradiance(path, phase))
    excess = np.mean((seen - expected) ** 2) / expected.var()
    assert excess < most


@pytest.mark.parametrize("half_width", [0.7, 1.0])
@pytest.mark.parametrize("pattern", ["noise", "chequerboard"])
def test_an_iris_edge_between_two_frequencies_passes_what_the_virtual_bench_passes(
    half_width: float, pattern: str
) -> None:
    """Each on its own padding, neither of them twice the panel. With whole samples the excess was 0.003 to 0.025."""
    shape, distance_mm = (96, 128), 4.0
    gray = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    if pattern == "chequerboard":  # as of double phase: much light near the edge of the panel's band
        gray = (64 * (np.indices(shape).sum(0) % 2) + gray // 4).astype(np.uint8)
    iris = IrisDescription(half_width=half_width)
    bench = replace(load_bench("virtual:ideal").resized(*shape, distance_mm), iris=iris)
    expected = VirtualHeadset(bench).true_irradiance(gray, "green", distance_mm)
    path = ideal_path(shape, 1e-3 * distance_mm, half_width)
    seen = pixel_irradiance(path, irradiance(path, panel_phase(path, gray.astype(int))))
    seen *= expected.mean() / seen.mean()
    assert np.mean((seen - expected) ** 2) < 0.0004 * expected.var()


def test_a_flat_panel_shows_about_its_own_irradiance() -> None:
    path = ideal_path((64, 64), 0.002)
    seen = pixel_irradiance(path, irradiance(path, np.zeros((64, 64))))
    assert seen[24:40, 24:40].mean() == pytest.approx(1, abs=0.01)


def test_gray_levels_are_looked_up_and_scaled_over_the_panel() -> None:
    path = random_path()
    gray = np.random.default_rng(0).integers(0, 256, (2, *path.grid.shape))
    np.testing.assert_allclose(panel_phase(path, gray), path.response[gray] * path.gain)
    np.testing.assert_allclose(panel_phase(replace(path, gain=None), gray), path.response[gray])


def test_energy_is_conserved_where_nothing_is_lost() -> None:
    """Parseval: the whole fine grid holds the energy of all pixels, when the whole period of frequencies
    passes.
    """
    shape, pitch = (20, 24), PITCH
    grid = grid_for(shape, pitch, 520e-9, 0.002, 1.0, margin=6)
    # Every frequency of the period once, and none twice: indices -n/2+1 .. n/2 of the band -n/2 .. n/2.
    once = np.ones((2 * grid.band[0] + 1, 2 * grid.band[1] + 1), complex)
    once[0, :], once[:, 0] = 0, 0
    rng = np.random.default_rng(2)
    transfer = once * np.exp(1j * rng.normal(size=once.shape))
    source = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    margin = (grid.padded[0] - shape[0]) // 2
    whole = replace(grid, margin=margin)
    path = LightPath(whole, np.zeros(256), source, transfer[None], np.ones(1), aperture=(1e-9, 1e-9))
    phase = rng.normal(size=shape)
    spectrum = panel_spectrum(path, phase)
    z = np.fft.ifft2(spectrum * transfer, s=(FINE * grid.padded[0], FINE * grid.padded[1])) * FINE**2
    assert np.sum(np.abs(z) ** 2) / FINE**2 == pytest.approx(np.sum(np.abs(source) ** 2), rel=1e-12)
    # and image_field is a window of that very field, up to a linear phase
    seen = np.abs(image_field(path, spectrum, 0)) ** 2
    first = -FINE * whole.margin
    index = [(first + np.arange(n)) % (FINE * p) for n, p in zip(whole.image_shape, grid.padded, strict=True)]
    np.testing.assert_allclose(seen, (np.abs(z) ** 2)[np.ix_(*index)], atol=1e-12 * seen.max())


@pytest.mark.parametrize("half_width", [1.0, 1.5, 1.95])
def test_irradiance_needs_no_finer_grid(half_width: float) -> None:
    """Four times finer samples of the same field, taken directly: equal where they coincide, and
    band-limited.
    """
    path = random_path((20, 24), half_width, irradiance_filter=None)
    grid, phase = path.grid, phases(random_path((20, 24)))
    fine = grid.fine
    spectrum = panel_spectrum(path, phase)
    coarse = mode_irradiance(path, spectrum)
    finer = 0
    for weight, transfer in zip(path.weights, path.transfers, strict=True):
        z = np.fft.ifft2(spectrum * transfer, s=tuple(4 * fine * n for n in grid.padded)) * (4 * fine) ** 2
        finer = finer + weight * np.abs(z) ** 2
    first = -fine * grid.margin
    index = [
        (4 * (first + np.arange(n))) % (4 * fine * p)
        for n, p in zip(grid.image_shape, grid.padded, strict=True)
    ]
    np.testing.assert_allclose(coarse, finer[np.ix_(*index)], atol=1e-12 * coarse.max())
    light = np.abs(np.fft.fft2(finer))
    kept = [np.abs(np.fft.fftfreq(n, 1 / n)) <= 2 * b for n, b in zip(finer.shape, grid.band, strict=True)]
    assert light[~np.logical_and.outer(*kept)].max() < 1e-12 * light.max()
    assert all(2 * b < fine * n for b, n in zip(grid.band, grid.padded, strict=True))


def test_pixels_integrate_irradiance_over_their_area() -> None:
    """Against the integral of a cosine over a pixel, in closed form."""
    path = ideal_path((24, 32), 0.002)
    height, width = path.grid.image_shape
    k = 11
    x = np.arange(width) / FINE - path.grid.margin  # of samples, in panel pixels
    cycles = k / (width / FINE)
    image = np.broadcast_to(2 + np.cos(2 * np.pi * cycles * x), (height, width))
    expected = 2 + np.sinc(cycles) * np.cos(2 * np.pi * cycles * np.arange(32))
    np.testing.assert_allclose(pixel_irradiance(path, image)[5], expected, atol=1e-12)
    np.testing.assert_allclose(at_pixels(path.grid, image)[5], 2 + np.cos(2 * np.pi * cycles * np.arange(32)))


def test_subpixels_of_equal_phase_are_the_pixel() -> None:
    """Crosstalk without mixing changes nothing, however finely the pixel is drawn."""
    path = random_path(crosstalk=None)
    alone = np.zeros((3, 5))
    alone[:, 2] = 1
    drawn = replace(path, crosstalk=(alone, alone[:2]))
    phase = phases(path)
    assert close(irradiance(drawn, phase), irradiance(path, phase)) < 1e-12


def test_neighbours_mix_towards_the_side_that_the_taps_say() -> None:
    phase = np.zeros((3, 7))
    phase[:, 3] = 1
    taps = np.array([[0.1, 0.7, 0.2], [0, 1, 0]])
    mixed, alone = mix_neighbours(phase, taps, -1)
    np.testing.assert_array_equal(mixed[0], [0, 0, 0.2, 0.7, 0.1, 0, 0])
    np.testing.assert_array_equal(alone, phase)
    border, _ = mix_neighbours(np.array([[1.0, 0, 0, 2]]), taps, -1)
    np.testing.assert_allclose(border[0], [0.8, 0.1, 0.4, 1.8])


@pytest.mark.parametrize("name", PATHS)
def test_the_gradient_is_the_adjoint_of_the_derivative(name: str) -> None:
    """<G, J d> = <J* G, d>, with J d by forward-mode differentiation, which shares no code with our adjoint."""
    path = PATHS[name]
    phase, direction = phases(path, 2), phases(path, 2, seed=4)
    gradient = np.random.default_rng(6).normal(size=(2, *path.grid.image_shape))
    in_torch = torch_path(path)
    _, moved = torch.func.jvp(
        lambda p: irradiance(in_torch, p), (torch.as_tensor(phase),), (torch.as_tensor(direction),)
    )
    forward = float(np.sum(gradient * moved.numpy()))
    backward = float(np.sum(phase_gradient(path, phase, gradient) * direction))
    scale = np.linalg.norm(gradient) * np.linalg.norm(moved.numpy())
    assert abs(forward - backward) < 1e-12 * scale
    assert forward == pytest.approx(backward, rel=1e-10)


@pytest.mark.parametrize("name", PATHS)
def test_the_gradient_is_that_of_automatic_differentiation(name: str) -> None:
    for dtype, most in ((np.float64, 1e-11), (np.float32, 1e-5)):
        path = converted(PATHS[name], dtype)
        phase = phases(path).astype(dtype)
        gradient = np.random.default_rng(6).normal(size=path.grid.image_shape).astype(dtype)
        by_hand = phase_gradient(path, phase, gradient)
        variable = torch.as_tensor(phase).requires_grad_()
        (irradiance(torch_path(path), variable) * torch.as_tensor(gradient)).sum().backward()
        assert by_hand.dtype == dtype
        assert relative(by_hand, variable.grad.numpy()) < most


@pytest.mark.parametrize("name", PATHS)
def test_numpy_and_torch_agree_to_rounding(name: str) -> None:
    for dtype, most in ((np.float64, 1e-12), (np.float32, 1e-5)):
        path = converted(PATHS[name], dtype)
        phase = phases(path, 2).astype(dtype)
        image = irradiance(path, phase)
        assert image.dtype == dtype
        assert image.shape == (2, *path.grid.image_shape)
        in_torch = torch_path(path)
        theirs = irradiance(in_torch, torch.as_tensor(phase))
        assert close(image, theirs.numpy()) < most
        assert close(pixel_irradiance(path, image), pixel_irradiance(in_torch, theirs).numpy()) < most


@pytest.mark.parametrize("name", PATHS)
def test_the_gradient_over_a_factor_is_what_differences_say(name: str) -> None:
    """A small complex change of source and leak alike, in a random direction."""
    path, rng = PATHS[name], np.random.default_rng(4)
    phase = phases(path, 1)[0]
    image, pullback = irradiance_and_pullback(path, phase, factor=True)
    slope = rng.normal(size=image.shape)
    over = pullback(slope)
    log, turn = rng.normal(size=(2, *path.grid.shape))

    def moved(step: float) -> float:
        factor = np.exp(step * (log + 1j * turn))
        leak = None if path.leak is None else path.leak * factor
        return float(np.sum(irradiance(replace(path, source=path.source * factor, leak=leak), phase) * slope))

    wanted = (moved(1e-5) - moved(-1e-5)) / 2e-5
    assert np.sum(over.real * log + over.imag * turn) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("name", ["everything", "no crosstalk"])
def test_a_batch_is_its_members(name: str) -> None:
    path = PATHS[name]
    phase = phases(path, 3)
    image, pullback = irradiance_and_pullback(path, phase)
    gradient = np.random.default_rng(1).normal(size=image.shape)
    together = pullback(gradient)
    for k in range(3):
        assert close(image[k], irradiance(path, phase[k])) < 1e-12
        assert close(together[k], phase_gradient(path, phase[k], gradient[k])) < 1e-12


def test_pixels_adjoint() -> None:
    path = PATHS["everything"]
    rng = np.random.default_rng(8)
    image, gradient = rng.normal(size=(2, *path.grid.image_shape)), rng.normal(size=(2, *path.grid.shape))
    forward = np.sum(pixel_irradiance(path, image) * gradient)
    assert forward == pytest.approx(np.sum(image * pixel_irradiance_adjoint(path, gradient)), rel=1e-10)


def test_light_does_not_come_back_on_the_other_side() -> None:
    """A blazed grating throws all light out over one border; nothing of it may enter over the other."""
    path = ideal_path((64, 64), 0.03)
    ramp = np.broadcast_to(2 * np.pi * 0.45 * np.arange(64), (64, 64))
    seen = pixel_irradiance(path, irradiance(path, ramp))
    expected = padded_irradiance(ramp, 0.03, oversampling=2, pad=6)
    assert np.abs(seen - expected).max() < 0.01 * expected.max() + 0.004


@pytest.mark.parametrize("first", [-7, 0, 3])
@pytest.mark.parametrize("count", [1, 5, 8, 19])
def test_windows_of_a_ring_and_their_adjoint(first: int, count: int) -> None:
    runs = ring(first, count, 8)
    x = np.arange(16.0).reshape(2, 8)
    taken = take(x, runs, -1)
    np.testing.assert_array_equal(taken, x[:, (first + np.arange(count)) % 8])
    y = np.random.default_rng(0).normal(size=taken.shape)
    assert np.sum(taken * y) == pytest.approx(np.sum(x * put(y, runs, -1, 8)))


def test_grids_have_room_for_the_light_and_for_what_follows() -> None:
    grid = grid_for((100, 120), PITCH, 520e-9, 0.2, 0.5)
    walk = 520e-9 * 0.2 * 0.5 / (2 * PITCH**2)
    assert all(p >= n + walk for p, n in zip(grid.padded, grid.shape, strict=True))
    near = grid_for((100, 120), PITCH, 520e-9, 1e-5, 1.0)
    assert all(p >= n + 2 * near.margin for p, n in zip(near.padded, near.shape, strict=True))
    closed = grid_for((100, 120), PITCH, 520e-9, 1e-5, 1.0, narrowest=0.25)
    assert all(p >= n + 8 * near.margin for p, n in zip(closed.padded, closed.shape, strict=True))
    assert all(p % 2 == 0 for p in (*grid.padded, *near.padded, *closed.padded))
    widest = grid_for((10, 10), PITCH, 520e-9, 1e-3, 1.95)
    assert all(2 * b + 1 <= FINE * p for b, p in zip(widest.band, widest.padded, strict=True))


def test_behind_half_of_the_band_a_sample_a_pixel_tells_all() -> None:
    """Irradiance has twice the band of the field: what lies between a pixel's samples follows from them."""
    path = ideal_path((96, 120), half_width=0.5)
    assert path.grid.fine == 1
    assert ideal_path((96, 120), half_width=0.51).grid.fine == FINE
    phase = phases(path)
    coarse, finer = (irradiance(p, phase) for p in (path, replace(path, grid=replace(path.grid, fine=FINE))))
    assert relative(coarse, finer[::FINE, ::FINE]) < 1e-12
    between = finer_picture(np.fft.rfft2(coarse), coarse.shape, FINE)
    inside = np.s_[24:-24, 24:-24]  # a spectrum takes a picture for periodic
    assert relative(between[inside], finer[inside]) < 1e-2
