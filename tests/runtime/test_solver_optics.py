"""The solver's in-place light path, the second copy, against `runtime.lightpath` to 1e-9 in double precision."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_iface.errors import InputError
from runtime.lightpath.grid import at_pixels
from runtime.lightpath.light_path import (
    LightPath,
    irradiance,
    mode_irradiance,
    panel_spectrum,
    pixel_irradiance,
    states,
)
from runtime.lightpath.light_path_adjoint import irradiance_and_pullback, pixel_irradiance_adjoint
from runtime.solver.array_backend import Backend
from runtime.solver.chosen_backend import backend
from runtime.solver.in_place_path import Optics
from tests.runtime.benches import PATHS, converted, torch_path


def drawn(path: LightPath) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A phase, a slope over light, and room for light."""
    rng = np.random.default_rng(4)
    shape = path.grid.shape
    return rng.normal(0, 2, shape), rng.normal(size=shape), np.zeros(shape)


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("threads", [1, 3])
def test_the_fine_grid_is_what_pixels_integrate(name: str, threads: int) -> None:
    path = PATHS[name]
    phase, _, light = drawn(path)
    Optics(path, path.grid.fine, True, Backend(threads)).forward(phase, light)
    np.testing.assert_allclose(light, pixel_irradiance(path, irradiance(path, phase)), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "name", ["iris half the band", "no crosstalk", "no crosstalk, wide", "two states, one mode", "ideal"]
)
def test_once_a_pixel_is_the_fine_grid_at_their_centres(name: str) -> None:
    path = PATHS[name]
    phase, _, light = drawn(path)
    Optics(path, 1, False, Backend(2)).forward(phase, light)
    light_of_states = sum(mode_irradiance(state, panel_spectrum(state, phase)) for state in states(path))
    expected = at_pixels(path.grid, light_of_states)
    np.testing.assert_allclose(light, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", PATHS)
def test_the_adjoint_is_the_other_copys(name: str) -> None:
    path = PATHS[name]
    phase, slope, light = drawn(path)
    optics, gradient = Optics(path, path.grid.fine, True, Backend(2)), np.zeros_like(phase)
    optics.forward(phase, light)
    optics.adjoint(phase, slope, gradient)
    expected = irradiance_and_pullback(path, phase)[1](pixel_irradiance_adjoint(path, slope))
    assert np.linalg.norm(gradient - expected) < 1e-9 * np.linalg.norm(expected)


@pytest.mark.parametrize("name", PATHS)
def test_the_adjoint_is_torchs_gradient(name: str) -> None:
    torch = pytest.importorskip("torch")
    path = PATHS[name]
    phase, slope, light = drawn(path)
    optics, gradient = Optics(path, path.grid.fine, True, Backend(2)), np.zeros_like(phase)
    optics.forward(phase, light)
    optics.adjoint(phase, slope, gradient)
    x = torch.tensor(phase, requires_grad=True)
    seen = torch_path(path)
    (pixel_irradiance(seen, irradiance(seen, x)) * torch.tensor(slope)).sum().backward()
    assert np.linalg.norm(gradient - x.grad.numpy()) < 1e-9 * np.linalg.norm(gradient)


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("integrate", [True, False])
def test_the_adjoint_once_a_pixel_is_the_derivative(name: str, integrate: bool) -> None:
    """<slope, dI> = <gradient, d phase> for a small change, by central differences."""
    path = PATHS[name]
    if name == "iris twice the band":
        with pytest.raises(InputError, match="crosstalk"):
            Optics(path, 1, integrate, Backend(1))
        return
    phase, slope, light = drawn(path)
    optics, gradient = Optics(path, 1, integrate, Backend(2)), np.zeros_like(phase)
    optics.forward(phase, light)
    optics.adjoint(phase, slope, gradient)
    way = np.random.default_rng(5).normal(size=phase.shape)
    change = []
    for sign in (1, -1):
        optics.forward(phase + sign * 1e-7 * way, light)
        change.append((light * slope).sum())
    assert (change[0] - change[1]) / 2e-7 == pytest.approx((gradient * way).sum(), rel=1e-6)


def test_single_precision_keeps_five_digits() -> None:
    path = PATHS["everything"]
    phase, slope, light = drawn(path)
    gradients = []
    for one in (path, converted(path, np.float32)):
        dtype = one.response.dtype
        optics = Optics(one, 2, True, Backend(2))
        seen, gradient = light.astype(dtype), np.zeros(phase.shape, dtype)
        optics.forward(phase.astype(dtype), seen)
        optics.adjoint(phase.astype(dtype), slope.astype(dtype), gradient)
        gradients.append(gradient)
    assert gradients[1].dtype == np.float32
    assert np.linalg.norm(gradients[1] - gradients[0]) < 1e-5 * np.linalg.norm(gradients[0])


def test_scipy_does_what_ducc_does(monkeypatch: pytest.MonkeyPatch) -> None:
    import scipy.fft

    from runtime.lightpath import fft

    path = PATHS["everything"]
    phase, slope, _ = drawn(path)
    results = []
    for library in (fft._ducc, None):
        monkeypatch.setattr(fft, "_ducc", library)
        monkeypatch.setattr(fft, "_scipy", scipy.fft, raising=False)
        light, gradient = np.zeros_like(phase), np.zeros_like(phase)
        optics = Optics(path, path.grid.fine, True, Backend(2))
        optics.forward(phase, light)
        optics.adjoint(phase, slope, gradient)
        results.append((light, gradient))
    np.testing.assert_allclose(results[0], results[1], rtol=1e-9, atol=1e-10)


def test_a_backend_that_is_not_there_is_refused() -> None:
    assert backend("numpy").name == "numpy"
    with pytest.raises(InputError, match="did you mean 'numpy'"):
        backend("nunpy")
    try:
        import cupy  # noqa: F401
    except ImportError:
        with pytest.raises(InputError, match="CuPy backend cannot start"):
            backend("cupy")
