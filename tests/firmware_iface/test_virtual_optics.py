"""Physics of the simulated bench: energy, orders, dead space, coherence, adjoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_iface.virtual import BenchDescription, VirtualHeadset, load_bench, make_defect
from firmware_iface.virtual.bench_description import IrisDescription, SimulationDescription
from firmware_iface.virtual.bench_optics import BenchOptics
from firmware_iface.virtual.simulated_drive import Drive, smear_weights
from firmware_iface.virtual.simulated_sensor import Integrator, interpolate
from firmware_iface.virtual.subpixel_propagation import Band
from tests.firmware_iface.padded_light import samples

H, W, Z = 64, 96, 12.0
NARROW = make_defect(
    "illumination", waist_x_share=0.3, waist_y_share=0.3, centre_x_share=0, centre_y_share=0, ring=0
)


def small(*defects, distance_mm=Z, **changes) -> BenchDescription:
    bench = load_bench("virtual:ideal").resized(H, W, distance_mm)
    return replace(bench, defects=tuple(defects), **changes)


def random_gray(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (H, W), dtype=np.uint8)


def test_all_light_of_a_beam_that_clears_the_iris_arrives():
    light, _, _, per_pixel = samples(small(NARROW), np.zeros((H, W), np.uint8), Z)
    assert light.sum() / per_pixel == pytest.approx(H * W, rel=1e-4)


@pytest.mark.parametrize("distance", [3.0, -3.0, 30.0])
def test_of_a_random_pattern_the_share_in_the_pixels_central_lobe_arrives(distance):
    light, _, _, per_pixel = samples(small(), random_gray(), distance)
    f = np.linspace(-0.5, 0.5, 2001)
    share = np.trapezoid(np.sinc(f) ** 2, f) ** 2
    assert light.sum() / per_pixel == pytest.approx(share * H * W, rel=0.02)


@pytest.mark.parametrize("period", [8, -16])
def test_a_grating_sends_light_where_geometry_says(period):
    gray = (256 * np.arange(W) / period % 256).astype(np.uint8)[None, :].repeat(H, 0)
    light, y, x, _ = samples(small(NARROW), gray, Z)
    sine = 520e-9 / (period * 8e-6)
    expected = Z * 1e-3 * sine / np.sqrt(1 - sine**2) / 8e-6
    assert (light * x).sum() / light.sum() == pytest.approx(expected, rel=0.01)
    assert abs((light * y).sum() / light.sum()) < 0.05


def test_dead_space_gives_the_zero_order_of_equations_9_to_11():
    fill, amplitude = 0.85, 0.6
    leak = make_defect("zero_order", fill_factor=fill, dead_amplitude=amplitude, surface_amplitude=0)
    bench = small(leak, iris=IrisDescription(half_width=0.5), distance_mm=0.3)
    checkerboard = (128 * (np.indices((H, W)).sum(0) % 2)).astype(np.uint8)  # its own orders miss the iris
    seen = VirtualHeadset(bench).true_irradiance(checkerboard, "green")
    centre = seen[20:-20, 20:-20].mean()
    assert centre == pytest.approx(((1 - fill) * amplitude) ** 2, rel=0.03)
    flat = VirtualHeadset(bench).true_irradiance(np.zeros((H, W), np.uint8), "green")
    phase = np.deg2rad(leak.dead_phase_deg)
    expected = abs(fill + (1 - fill) * amplitude * np.exp(1j * phase)) ** 2
    assert flat[20:-20, 20:-20].mean() == pytest.approx(expected, rel=0.01)


def test_a_sources_extent_blurs_by_distance_times_angle():
    gray = np.zeros((H, W), np.uint8)
    radius_px = Z * 0.8e-3 / 8e-3

    def spread(bench):
        light, _, x, _ = samples(bench, gray, Z)
        return (light * x**2).sum() / light.sum()

    grown = spread(small(NARROW, make_defect("spatial_coherence", radius_mrad=0.8))) - spread(small(NARROW))
    assert grown == pytest.approx(radius_px**2 / 4, rel=0.03)


def test_a_wide_line_washes_out_what_the_edge_of_the_band_carries():
    gray = random_gray(1)
    sharp = VirtualHeadset(small()).true_irradiance(gray, "green")
    wide = VirtualHeadset(small(make_defect("temporal_coherence", linewidth_nm=30.0))).true_irradiance(
        gray, "green"
    )
    assert wide.std() < 0.97 * sharp.std()
    assert wide.mean() == pytest.approx(sharp.mean(), rel=0.02)


def test_a_distance_defect_is_another_plane():
    gray = random_gray(2)
    shifted = VirtualHeadset(small(make_defect("distance", offset_mm=0.7))).true_irradiance(gray, "green", Z)
    np.testing.assert_allclose(shifted, VirtualHeadset(small()).true_irradiance(gray, "green", Z + 0.7))


def test_the_number_of_sub_pixels_does_not_matter_without_sub_pixel_structure():
    gray = random_gray(3)
    coarse, fine = (
        VirtualHeadset(small(simulation=SimulationDescription(subpixels=q))).true_irradiance(gray, "green")
        for q in (4, 8)
    )
    np.testing.assert_allclose(coarse, fine, atol=2e-5)


@pytest.mark.parametrize("fill_factor", [0.9, 0.7, 0.4])
def test_dead_space_is_as_wide_whatever_the_number_of_sub_pixels(fill_factor):
    gray = random_gray(5)
    bench = small()
    panel = replace(bench.panel, fill_factor=fill_factor)
    coarse, fine = (
        VirtualHeadset(
            replace(bench, panel=panel, simulation=SimulationDescription(subpixels=q))
        ).true_irradiance(gray, "green")
        for q in (4, 16)
    )
    # Weighted by the covered area alone, these would be 0.0007, 0.0064 and 0.0086.
    assert np.mean((coarse - fine) ** 2) < 0.0001 * fine.var()


def test_iris_edges_pass_and_an_offset_moves_the_window():
    bench = small(make_defect("iris", half_width=0.5, centre_x_share=0.25, centre_y_share=0))
    optics = BenchOptics(bench)
    path = optics.path("green", Z)
    passed = np.abs(path.lines[0].transfer) > 0
    fx = 2 * path.band.fx[passed.any(0)]
    assert fx.min() == pytest.approx(-0.25, abs=0.02) and fx.max() == pytest.approx(0.75, abs=0.02)
    whole = BenchOptics(small()).path("green", Z)
    assert whole.band.fx[0] == -0.5 and whole.band.fx[-1] == 0.5
    assert np.all(np.abs(whole.lines[0].transfer) > 0)


@pytest.mark.parametrize("shape, rotation_deg", [("circle", 0.0), ("square", 30.0), ("square", 0.0)])
def test_a_sharp_edge_is_the_same_on_every_grid_of_frequencies(shape, rotation_deg):
    iris = make_defect("iris", shape=shape, half_width=0.6, rotation_deg=rotation_deg)
    gray = random_gray(4)
    pictures = [
        VirtualHeadset(small(iris, simulation=SimulationDescription(padding=padding))).true_irradiance(
            gray, "green", Z
        )
        for padding in (2, 15)
    ]
    # As steps, the edge would differ by 0.0014, 0.0005 and 0.0025.
    assert np.mean((pictures[0] - pictures[1]) ** 2) < 0.0003 * pictures[1].var()


def test_fringing_weights_hold_the_kernels_area_and_centre():
    width, asymmetry, q = 0.3, 0.4, 8
    weights = smear_weights(width, asymmetry, q)
    at = (np.arange(q) + 0.5) / q - 0.5
    j = np.arange(weights.shape[1]) - weights.shape[1] // 2
    np.testing.assert_allclose(weights.sum(1), 1)
    centre = (weights * (at[:, None] - j)).sum() / q
    assert centre == pytest.approx(2 * width * asymmetry, rel=0.02)


def test_longer_waves_get_less_phase_from_the_same_gray():
    bench = load_bench("virtual:colour")
    red, blue = (Drive(bench, c.wavelength_nm) for c in (bench.channel("red"), bench.channel("blue")))
    full = np.full((1, 1), 255.0)
    assert red.magnitude(full)[0, 0] < 2 * np.pi * 1.1 < blue.magnitude(full)[0, 0] * 1.01


def test_phase_curve_is_monotone_and_inverted_where_it_is_wrapped():
    for name in ("phase_response", "phase_nonuniformity", "ideal"):
        drive = Drive(load_bench(f"virtual:{name}").resized(H, W), 520.0)
        ramp = np.broadcast_to(np.arange(256.0)[:, None, None], (256, 1, 1))
        for gray in ramp[::64]:
            assert np.all(drive.slope(np.full((H, W), gray[0, 0])) > 0)
        asked = np.random.default_rng(0).uniform(-40, 330, (H, W))
        kept = drive.wrapped(asked)
        assert kept.min() >= 0 and kept.max() <= 255
        inside = (kept > 0) & (kept < 255) & (asked > 0)
        difference = drive.magnitude(asked) - drive.magnitude(kept)
        turn = np.exp(1j * difference)[inside]
        np.testing.assert_allclose(turn, 1, atol=0.03)


def test_band_adjoints_pass_the_dot_product_test():
    rng = np.random.default_rng(4)
    band = Band((10, 14), 4, 9, 0.5)

    def noise(*shape):
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)

    u, s = noise(40, 56), noise(len(band.fy), len(band.fx))
    assert np.vdot(s, band.spectrum(u)) == pytest.approx(np.vdot(band.spectrum_adjoint(s), u), rel=1e-4)
    z = noise(*band.samples)
    assert np.vdot(z, band.field(s)) == pytest.approx(np.vdot(band.field_adjoint(z), s), rel=1e-4)


def test_integrator_adjoint_passes_the_dot_product_test():
    rng = np.random.default_rng(5)
    bench = small(make_defect("ghost"))
    integrator = Integrator(bench, (160, 240), 2)
    light = rng.standard_normal((160, 240)).astype(np.float32)
    pixels = rng.standard_normal((H, W)).astype(np.float32)
    left = np.vdot(pixels, integrator.display(light))
    assert left == pytest.approx(np.vdot(integrator.display_adjoint(pixels), light), rel=1e-3)


def test_gradient_agrees_with_finite_differences():
    bench = small(
        make_defect("crosstalk"),
        make_defect("zero_order"),
        make_defect("phase_response"),
        make_defect("phase_nonuniformity"),
        make_defect("pupil_aberration"),
        make_defect("temporal_coherence", lines=3),
        make_defect("spatial_coherence", rings=1),
    )
    optics = BenchOptics(bench)
    rng = np.random.default_rng(6)
    gray = rng.uniform(20, 230, (H, W))
    light, pullback = optics.irradiance_and_pullback(gray, "green", Z)
    weights = rng.standard_normal(light.shape).astype(np.float32)
    gradient = pullback(weights)
    direction = np.sign(gradient)
    step = 0.05

    def value(t):
        return float((optics.irradiance(gray + t * direction, "green", Z) * weights).sum(dtype=np.float64))

    slope = (value(step) - value(-step)) / (2 * step)
    assert slope == pytest.approx((gradient * direction).sum(), rel=2e-3)


def test_smear_adjoint_passes_the_dot_product_test():
    rng = np.random.default_rng(7)
    drive = Drive(small(make_defect("crosstalk", width_x_px=0.5)), 520.0)
    a = rng.standard_normal((H, W)).astype(np.float32)
    b = rng.standard_normal((4 * H, 4 * W)).astype(np.float32)
    assert np.vdot(b, drive.spread(a)) == pytest.approx(np.vdot(drive.spread_adjoint(b), a), rel=1e-3)


def test_interpolation_is_exact_enough_for_what_a_pixel_passes():
    t = np.arange(64)
    image = np.cos(2 * np.pi * 8 * t / 64)[:, None] * np.ones((1, 64))  # eight samples a period
    at = np.linspace(3, 50, 97)[:, None]
    exact = np.cos(2 * np.pi * 8 * at / 64)
    np.testing.assert_allclose(interpolate(image, at, np.full_like(at, 20.3)), exact, atol=3e-3)
