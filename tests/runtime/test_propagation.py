"""Propagation against solutions in closed form: a Gaussian beam, a grating's self-image, a slit far away."""

from __future__ import annotations

import math

import numpy as np
import pytest

from firmware_iface.errors import InputError
from runtime.lightpath.propagation import Aperture, band_limit, check_sampling, far_field, transfer_function

PITCH, WAVELENGTH, N = 8e-6, 520e-9, 512
WAIST = 0.16e-3
RAYLEIGH = math.pi * WAIST**2 / WAVELENGTH  # 155 mm


def coordinates(n: int = N, pitch: float = PITCH) -> np.ndarray:
    return (np.arange(n) - n / 2) * pitch


def propagated(
    field: np.ndarray, distance: float, method: str = "angular_spectrum", limits: float = np.inf
) -> np.ndarray:
    """Through `transfer_function` on the field's own periodic grid."""
    fy, fx = (np.fft.fftfreq(n, PITCH) for n in field.shape)
    transfer = transfer_function(fy[:, None], fx[None, :], WAVELENGTH, distance, (limits, limits), method)
    return np.fft.ifft2(np.fft.fft2(field) * transfer)


def gaussian_beam(z: float) -> np.ndarray:
    """Paraxial beam with its waist at z = 0 (Siegman, Lasers, ch. 17), without the plane wave's own phase."""
    r2 = coordinates()[:, None] ** 2 + coordinates()[None, :] ** 2
    q = 1 / (1 + 1j * z / RAYLEIGH)
    return q * np.exp(-r2 / WAIST**2 * q)


@pytest.mark.parametrize("method", ["angular_spectrum", "fresnel"])
@pytest.mark.parametrize("distance", [0.02, 0.1, RAYLEIGH, 0.4, -0.1])
def test_a_gaussian_beam(method: str, distance: float) -> None:
    """Width, curvature and phase, from the waist on; the paraxial solution is itself off by 1e-6."""
    field = propagated(gaussian_beam(0), distance, method)
    expected = gaussian_beam(distance)
    assert np.abs(field - expected).max() < 3e-4 * np.abs(expected).max()
    x = coordinates()
    light = (np.abs(field) ** 2).sum(0)
    width = 2 * math.sqrt(float((light * x**2).sum() / light.sum()))
    assert width == pytest.approx(WAIST * math.sqrt(1 + (distance / RAYLEIGH) ** 2), rel=2e-3)


@pytest.mark.parametrize("start", [-0.2, -0.05, 0.1])
def test_a_curved_beam_is_followed_through_its_waist(start: float) -> None:
    for end in (-0.1, 0.0, 0.2):
        if end == start:
            continue
        field = propagated(gaussian_beam(start), end - start)
        assert np.abs(field - gaussian_beam(end)).max() < 1e-3 * np.abs(gaussian_beam(end)).max()


def test_steep_light_tells_the_exact_form_from_the_paraxial_one() -> None:
    """A single plane wave at 15 degrees: the phase is 2 pi z / lambda (cos a - 1), which Fresnel misses."""
    f = math.sin(math.radians(15)) / WAVELENGTH
    z = 1e-4
    fy, fx = np.zeros((1, 1)), np.full((1, 1), f)
    exact = transfer_function(fy, fx, WAVELENGTH, z, (np.inf, np.inf), "angular_spectrum")[0, 0]
    turn = 2 * math.pi * z / WAVELENGTH * (math.cos(math.radians(15)) - 1)
    assert exact == pytest.approx(np.exp(1j * turn), abs=1e-9)
    paraxial = transfer_function(fy, fx, WAVELENGTH, z, (np.inf, np.inf), "fresnel")[0, 0]
    assert abs(paraxial - exact) > 0.1


def test_a_grating_images_itself_at_the_talbot_distance() -> None:
    period = 16 * PITCH
    talbot = WAVELENGTH / (1 - math.sqrt(1 - (WAVELENGTH / period) ** 2))  # exact; about 2 period^2 / lambda
    x = np.arange(N) * PITCH
    field = np.broadcast_to(1 + np.cos(2 * np.pi * x / period), (16, N)).astype(complex)
    light = np.abs(propagated(field, talbot)) ** 2
    np.testing.assert_allclose(light, np.abs(field) ** 2, atol=1e-9)
    half = np.abs(propagated(field, talbot / 2)) ** 2
    np.testing.assert_allclose(half, np.roll(np.abs(field) ** 2, 8, 1), atol=1e-9)
    quarter = np.abs(propagated(field, talbot / 4)) ** 2  # contrast at twice the frequency only
    np.testing.assert_allclose(
        quarter, 1 + np.cos(2 * np.pi * x / period)[None] ** 2 * np.ones((16, 1)), atol=1e-9
    )


def test_energy_is_kept_and_the_way_back_is_the_inverse() -> None:
    rng = np.random.default_rng(0)
    field = rng.normal(size=(64, 96)) + 1j * rng.normal(size=(64, 96))
    for method in ("angular_spectrum", "fresnel"):
        there = propagated(field, 0.05, method)
        assert np.sum(np.abs(there) ** 2) == pytest.approx(np.sum(np.abs(field) ** 2), rel=1e-12)
        np.testing.assert_allclose(propagated(there, -0.05, method), field, atol=1e-10)


def test_frequencies_beyond_the_limits_and_evanescent_ones_are_stopped() -> None:
    f = np.array([0.0, 1e4, 2e4, 1.9e6, 2e6])
    along = transfer_function(
        f[:, None], np.zeros((1, 1)), WAVELENGTH, 0.01, (np.inf, np.inf), "angular_spectrum"
    )
    np.testing.assert_allclose(np.abs(along[:, 0]), [1, 1, 1, 1, 0], atol=1e-12)
    limited = transfer_function(f[:, None], f[None, :], WAVELENGTH, 0.01, (1.5e4, 2.5e4), "angular_spectrum")
    passed = (f[:, None] <= 1.5e4) & (f[None, :] <= 2.5e4)
    np.testing.assert_array_equal(np.abs(limited) > 0.5, passed)
    with pytest.raises(InputError, match="'fraunhofer' has no transfer function"):
        transfer_function(f[:, None], f[None, :], WAVELENGTH, 0.01, (1.0, 1.0), "fraunhofer")


def test_single_precision_keeps_the_phase_of_small_angles() -> None:
    f = np.fft.fftfreq(1000, PITCH)
    exact = transfer_function(f[:, None], f[None, :], WAVELENGTH, 0.03, (np.inf, np.inf), "angular_spectrum")
    g = f.astype(np.float32)
    single = transfer_function(g[:, None], g[None, :], WAVELENGTH, 0.03, (np.inf, np.inf), "angular_spectrum")
    assert single.dtype == np.complex64
    assert np.abs(single - exact).max() < 3e-4  # of 770 rad at the corner


def test_the_limit_of_the_sampled_transfer_function() -> None:
    """There the phase of neighbouring frequency samples differs by half a turn."""
    side, z = N * PITCH, 0.3
    limit = band_limit(WAVELENGTH, z, side)
    step = 1e-4 / side
    slope = [z * math.sqrt(1 / WAVELENGTH**2 - f**2) for f in (limit - step, limit + step)]
    assert abs(slope[1] - slope[0]) / (2 * step) / side == pytest.approx(0.5, rel=1e-3)


def test_a_slit_far_away() -> None:
    width, z = 0.4e-3, 5.0
    field = np.zeros((1, 400), complex)
    field[0, 150:250] = 1
    pitch = width / 100
    x = np.linspace(-20e-3, 20e-3, 101)
    seen = far_field(field, pitch, np.zeros(1), x, WAVELENGTH, z)
    exact = width * pitch / (WAVELENGTH * z) * np.sinc(width * x / (WAVELENGTH * z))
    np.testing.assert_allclose(np.abs(seen[0]), np.abs(exact), atol=2e-3 * exact.max())
    assert np.abs(seen[0]).argmax() == 50
    dark = far_field(field, pitch, np.zeros(1), np.array([WAVELENGTH * z / width]), WAVELENGTH, z)
    assert abs(dark[0, 0]) < 1e-10 * exact.max()


def test_far_away_fresnel_is_fraunhofer() -> None:
    u = np.zeros((64, 64), complex)
    u[28:36, 30:34] = 1 + 0.5j
    big = np.zeros((2048, 2048), complex)
    big[992:1056, 992:1056] = u
    z = 0.06  # 30 times the square of the aperture over the wavelength
    seen = np.abs(propagated(big, z, "fresnel")) ** 2
    at = (np.arange(1000, 1046, 5) - 1023.5) * PITCH
    far = np.abs(far_field(u, PITCH, at, at, WAVELENGTH, z)) ** 2
    near = seen[1000:1046:5, 1000:1046:5]
    assert np.abs(near - far).max() < 0.03 * far.max()


HALF_BAND = 1 / (2 * PITCH)
PANEL = Aperture((1080, 1920), (1512, 2352), PITCH)


@pytest.mark.parametrize("method", ["angular_spectrum", "fresnel"])
def test_what_can_be_sampled_passes(method: str) -> None:
    check_sampling(method, PANEL, WAVELENGTH, 0.2, 0.5 * HALF_BAND)
    check_sampling(method, PANEL, WAVELENGTH, -0.2, 0.5 * HALF_BAND)
    check_sampling("fraunhofer", Aperture((10, 10), (10, 10), PITCH), WAVELENGTH, 1.0, HALF_BAND)


def test_every_refusal_says_which_limit_by_how_much_and_what_would_hold() -> None:
    def refused(*arguments: object) -> str:
        with pytest.raises(InputError) as caught:
            check_sampling(*arguments)  # type: ignore[arg-type]
        return str(caught.value)

    assert "unknown propagation method 'fourier': use one of angular_spectrum, fresnel" in refused(
        "fourier", PANEL, WAVELENGTH, 0.2, HALF_BAND
    )
    for wavelength, distance in (
        (0.0, 0.2),
        (-1e-9, 0.2),
        (math.nan, 0.2),
        (WAVELENGTH, 0.0),
        (WAVELENGTH, math.inf),
    ):
        assert "positive wavelength and a distance that is not zero" in refused(
            "angular_spectrum", PANEL, wavelength, distance, HALF_BAND
        )
    text = refused("fraunhofer", PANEL, WAVELENGTH, 0.2, HALF_BAND)
    least = 2 * (1920 * PITCH) ** 2 / WAVELENGTH
    assert f"{least:.3g} m" in text and "0.2 m" in text and "use angular_spectrum" in text
    text = refused("angular_spectrum", Aperture((64, 64), (96, 96), 0.2e-6), WAVELENGTH, 0.01, 1 / 0.4e-6)
    assert "beyond 1/lambda = 1923" in text and "2500 cycles/mm" in text and "coarser pitch" in text


def test_fresnel_names_a_distance_that_holds() -> None:
    fine = Aperture((2000, 2000), (8000, 8000), 2e-6)
    half_band, z = 1 / (2 * 2e-6), 0.02
    with pytest.raises(InputError, match="Fresnel propagation errs by") as caught:
        check_sampling("fresnel", fine, WAVELENGTH, z, half_band)
    farthest = float(str(caught.value).split("below ")[1].split(" mm")[0]) * 1e-3
    check_sampling("fresnel", fine, WAVELENGTH, 0.98 * farthest, half_band)
    with pytest.raises(InputError):
        check_sampling("fresnel", fine, WAVELENGTH, 1.05 * farthest, half_band)
    check_sampling("angular_spectrum", fine, WAVELENGTH, z, half_band)


def test_too_far_for_the_grid_names_a_distance_that_holds() -> None:
    small = Aperture((100, 100), (200, 200), PITCH)
    with pytest.raises(InputError, match="transfer function carries .* cycles/mm of the 62.5 ") as caught:
        check_sampling("angular_spectrum", small, WAVELENGTH, 0.5, HALF_BAND)
    farthest = float(str(caught.value).split("at most ")[1].split(" mm")[0]) * 1e-3
    check_sampling("angular_spectrum", small, WAVELENGTH, 0.98 * farthest, HALF_BAND)
