"""Physics of what a panel does beside the first kinds of defects, on a simulated bench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_iface.virtual import VirtualHeadset, make_defect
from firmware_iface.virtual.bench_optics import BenchOptics
from firmware_iface.virtual.rough_surface import rough_surface, spline_weights
from firmware_iface.virtual.simulated_panel import Surface, beam_amplitude, disc_gain, panel_path_nm
from firmware_iface.virtual.simulated_sensor import fringes
from tests.firmware_iface.padded_light import samples
from tests.firmware_iface.small_bench import (
    LINEAR,
    NARROW,
    SPOT,
    H,
    W,
    Z,
    grating,
    order_power,
    quiet,
    random_gray,
    small,
    uniform,
)


def test_a_uniform_patterns_energy_follows_the_amplitude_curve():
    d = make_defect("amplitude_modulation")
    for level in (0, 100, 255):
        light, whole = (samples(small(NARROW, *more), uniform(level), Z)[0].sum() for more in ((d,), ()))
        t = level / 255
        expected = (1 - d.fall * (t + d.curvature * t * (1 - t))) ** 2
        assert light / whole == pytest.approx(expected, rel=1e-4)
    assert (1 - d.fall) ** 2 == pytest.approx(0.82**2)


def test_crosstalk_smears_the_amplitude_as_it_smears_the_phase():
    step = uniform()
    step[:, W // 2 :] = 255
    absorbing = make_defect("amplitude_modulation", fall=0.5)
    smear = make_defect("crosstalk", width_x_px=0.8, asymmetry_x=0)
    sharp, smeared = (
        BenchOptics(small(absorbing, *more)).drive("green").amplitude(step) for more in ((), (smear,))
    )
    for amplitude in (sharp, smeared):
        assert amplitude[:, 8].mean() == pytest.approx(1) and amplitude[:, -8].mean() == pytest.approx(0.5)
    middle = slice(4 * W // 2 - 4, 4 * W // 2 + 4)
    assert sharp.shape[1] == 1 or np.ptp(sharp[0, middle]) == 0.5
    falls = np.diff(smeared[0, middle])
    assert np.all(falls < -0.02) and np.all(falls > -0.2)


@pytest.mark.parametrize("interferes", [True, False])
def test_a_leak_fills_the_orders_that_its_weaker_phase_gives(interferes):
    leak = make_defect("polarisation_leak", amplitude=0.3, interferes=interferes)
    k = np.arange(4)
    # of four columns of a blaze, each a quarter of the leak's phase apart: its amplitude in an order
    weak = {m: np.exp(2j * np.pi * k * (leak.gain - m) / 4).mean() for m in (0, 1, -1)}
    factor = leak.amplitude * np.exp(1j * np.deg2rad(leak.phase_deg))
    for order, own in ((0, 0.0), (1, 1.0), (-1, 0.0)):
        second = factor * weak[order]
        expected = abs(own + second) ** 2 if interferes else own + abs(second) ** 2
        plain = order_power(small(NARROW), grating(4), 1)
        found = order_power(small(NARROW, leak), grating(4), order) / plain
        assert found * np.sinc(0.25) ** 2 == pytest.approx(expected * np.sinc(order / 4) ** 2, abs=2e-3)


def test_a_slow_panel_still_shows_a_share_of_what_was_before():
    share = 0.08
    headset = quiet(make_defect("slow_response"))
    first, second = random_gray(1), random_gray(2)
    seen = []
    for gray in (first, second, second):
        headset.panel.show(gray)
        seen.append(headset.camera.capture().astype(float))
    ideal = quiet()
    asked = np.zeros(
        (H, W)
    )  # the panel begins with gray 0; its phase is straight, so gray levels mix as phases do
    for gray, counts in zip((first, second, second), seen, strict=True):
        asked = (1 - share) * gray + share * asked
        light = ideal._optics.irradiance(asked, "green", Z)
        electrons = ideal._sensor.electrons(ideal._integrator("green", Z).camera(light), 1.0)
        np.testing.assert_allclose(counts, ideal._sensor.counts(electrons), rtol=5e-3, atol=5)
    assert np.abs(seen[2] - seen[1]).mean() > 0.02 * seen[1].mean()


def test_what_a_slow_panel_shows_depends_on_its_history_and_forgets_it():
    pictures = []
    for history in ((random_gray(3),), (random_gray(4),)):
        headset = quiet(make_defect("slow_response", share=0.3))
        for gray in history:
            headset.panel.show(gray)
            headset.camera.capture()
        headset.panel.show(random_gray(5))
        pictures.append([headset.camera.capture().astype(float) for _ in range(9)])
    difference = [np.abs(a - b).mean() for a, b in zip(*pictures, strict=True)]
    assert difference[0] > 0.1 * pictures[0][0].mean()
    assert difference[8] < 1e-3 * difference[0]
    settled = quiet().expected_counts(random_gray(5), "green")
    np.testing.assert_allclose(pictures[0][8], settled, rtol=5e-3, atol=10)


def test_a_slow_panel_can_be_told_what_it_showed_and_for_how_long():
    told, taken = (quiet(make_defect("slow_response", share=0.3)) for _ in range(2))
    history = [(random_gray(k), periods) for k, periods in ((1, 30), (2, 1), (3, 2))]
    for gray, periods in history:
        taken.panel.show(gray)
        for _ in range(periods):
            taken.camera.capture()
    told.has_shown(history)
    seen = []
    for headset in (told, taken):
        headset.panel.show(random_gray(4))
        seen.append(headset.camera.capture().astype(float))
    assert np.abs(seen[0] - seen[1]).mean() < 1e-3 * seen[0].mean()
    told.has_shown([(random_gray(4), 1)])
    assert np.abs(told.camera.capture() - seen[0]).mean() > 0.05 * seen[0].mean()


def test_ripple_is_the_mean_of_five_gains():
    gray = random_gray(6)
    seen = VirtualHeadset(small(make_defect("phase_ripple"))).true_irradiance(gray, "green")
    gains = [
        VirtualHeadset(small(make_defect("phase_response", gain=1 + 0.14 * u, **LINEAR))).true_irradiance(
            gray, "green"
        )
        for u in (-1, -0.5, 0, 0.5, 1)
    ]
    np.testing.assert_allclose(seen, np.mean(gains, 0), atol=2e-5)
    assert np.abs(seen - gains[2]).max() > 0.05


def test_a_rippling_offset_shows_against_light_that_is_not_modulated():
    surface = make_defect("zero_order", fill_factor=1.0, surface_amplitude=0.4, surface_phase_deg=0.0)
    ripple = make_defect("phase_ripple", depth=0.0, offset_rad=1.2)

    def centre(*defects):
        return (
            VirtualHeadset(small(*defects, propagation=replace(small().propagation, distance_mm=0.3)))
            .true_irradiance(uniform(), "green")[16:-16, 16:-16]
            .mean()
        )

    expected = np.mean([abs(np.exp(1.2j * u) + 0.4) ** 2 for u in (-1, -0.5, 0, 0.5, 1)])
    assert centre(surface, ripple) == pytest.approx(expected, rel=5e-3)
    assert centre(ripple) == pytest.approx(centre(), rel=1e-4)


def test_drivers_send_light_into_orders_of_their_period():
    plain = order_power(small(NARROW), uniform(), 0)
    found = {}
    for period in (2, 3, 4):
        bench = small(NARROW, make_defect("drivers", column_period=period, row_offset_rad=0.0))
        assert 1 - order_power(bench, uniform(), 0) / plain == pytest.approx(0.12**2, rel=0.05)
        found[period] = [order_power(bench, uniform(), order) for order in (1, -1, 4 / 3, -4 / 3)]
    assert min(found[4][:2]) > 100 * max(found[2][:2])  # a quarter of a cycle a column
    assert min(found[4][:2]) > 3 * max(found[3][:2])  # the skirts of their orders overlap
    assert min(found[3][2:]) > 3 * max(found[4][2:])  # a third
    # at gray 128 the gains count as well: of half a wave
    for gains in (0.0, 0.03):
        bench = small(
            NARROW,
            make_defect(
                "drivers", column_offset_rad=0.0, row_offset_rad=0.0, row_gain=0.0, column_gain=gains
            ),
        )
        lost = 1 - order_power(bench, uniform(128), 0) / plain
        assert lost == pytest.approx((np.pi * gains) ** 2, rel=0.05, abs=1e-5)


def test_drivers_repeat_along_rows_too_and_other_seeds_differ():
    offsets = [
        BenchOptics(small(make_defect("drivers", seed=seed))).drive("green").magnitude(np.zeros((H, W)))
        for seed in (1, 2)
    ]
    for offset in offsets:
        np.testing.assert_array_equal(offset[:, 4:], offset[:, :-4])
        np.testing.assert_array_equal(offset[2:], offset[:-2])
        assert offset.mean(0).std() == pytest.approx(0.12, rel=1e-4)
        assert offset.mean(1).std() == pytest.approx(0.06, rel=1e-4)
    assert np.abs(offsets[0] - offsets[1]).max() > 0.05


def test_a_second_path_interferes_and_its_sign_flips_with_its_phase():
    def seen(amplitude, phase_deg, shift):
        ghost = make_defect(
            "coherent_ghost", amplitude=amplitude, phase_deg=phase_deg, shift_y_px=shift, shift_x_px=-shift
        )
        return samples(small(SPOT, ghost), uniform(), 0.5)

    whole = samples(small(SPOT), uniform(), 0.5)[0].sum()
    for phase in (0, 90, 180):
        light = seen(0.12, phase, 0.0)[0].sum()
        assert light / whole == pytest.approx(abs(1 + 0.12 * np.exp(1j * np.deg2rad(phase))) ** 2, rel=1e-3)
    near, opposite, none = (seen(a, phase, 4.0)[0] for a, phase in ((0.12, 0), (0.12, 180), (0.0, 0)))
    light, y, x, _ = seen(0.12, 50, 40.0)
    copy = light * (np.hypot(y - 40, x + 40) < 12)  # far apart, the copy has its share whatever its phase
    assert copy.sum() / whole == pytest.approx(0.12**2, rel=0.02)
    term = near - none, opposite - none
    interference = (term[0] - term[1]) / 2
    assert interference.sum() > 0.05 * whole
    assert ((term[0] + term[1]) / 2).sum() == pytest.approx(0.12**2 * whole, rel=0.01)


def test_the_delay_of_the_second_path_counts_as_a_gray_levels_does():
    """Of a blaze of 16 columns, a copy 4 columns on is a quarter of a wave behind; the delay brings it back."""
    light = {}
    for phase in (90, -90):
        ghost = make_defect("coherent_ghost", phase_deg=phase, shift_y_px=0.0, shift_x_px=4.0)
        light[phase] = samples(small(NARROW, ghost), grating(16), Z)[0].sum()
    assert light[90] / light[-90] == pytest.approx((1.12 / 0.88) ** 2, rel=0.1)


def test_a_rough_wavefront_and_beam_have_the_rms_that_is_asked_for():
    flat, rough = (
        panel_path_nm(make_defect("panel_wavefront", rough_rms_rad=rms), 4 * H, 4 * W, W / H)
        for rms in (0.0, 0.15)
    )
    added = (rough - flat) * 2 * np.pi / 520
    assert added.std() == pytest.approx(0.15, rel=1e-6) and abs(added.mean()) < 1e-9
    plain, spotted = (
        beam_amplitude(make_defect("illumination", rough_rms=rms), 4 * H, 4 * W) for rms in (0.0, 0.1)
    )
    assert np.mean(spotted**2) == pytest.approx(1)
    assert np.log(spotted / plain).std() == pytest.approx(0.1, rel=1e-6)


def test_a_rough_surface_passes_smoothly_through_its_nodes():
    weights = spline_weights(701, 8)  # seven intervals; cell k's centre is a node at k = 50, 150, ...
    values = np.random.default_rng(0).standard_normal(8)
    curve = weights @ values
    at = (np.arange(701) + 0.5) / 701 * 7
    np.testing.assert_allclose(np.interp(np.arange(8), at, curve)[1:-1], values[1:-1], atol=2e-3)
    np.testing.assert_allclose(
        spline_weights(50, 5) @ np.arange(5.0), (np.arange(50) + 0.5) / 50 * 4, atol=1e-12
    )
    assert np.abs(np.diff(curve, 3)).max() < 1e-4 * np.ptp(curve)  # no kinks
    first, again, other = (rough_surface((7, 9), seed, 60, 80) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.5


def test_fringes_and_stripes_fade_and_a_discs_phase_has_a_gain():
    gain = fringes(make_defect("fringes", fade=1.0, period_px=4.0, chirp=0.0), H, W)
    assert np.std(gain[:, -4:]) == pytest.approx(2 * 0.22 / np.sqrt(2), rel=0.1)
    assert np.std(gain[:, :4]) < 0.02
    stripes = Surface(small(make_defect("stripes", fade=1.0)), 520.0).lit
    assert np.std(np.abs(stripes[0])) < 0.01 < 0.2 < np.std(np.abs(stripes[-1]))
    radii = {"smallest_radius_px": 6.0, "largest_radius_px": 6.0}
    disc = make_defect("specks", count=1, places=3, phase_gain=0.5, **radii)
    found = disc_gain(disc, H, W)
    assert (found.min(), found.max()) == (0.5, 1.0)
    assert np.isclose(found, 0.5).mean() == pytest.approx(np.pi * 36 / (H * W), rel=0.2)
    assert disc_gain(make_defect("specks"), H, W).shape == (1, 1)
