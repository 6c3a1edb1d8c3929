"""Physics of vibration, of a camera that moves, of its fixed pattern, of several lines and of an iris."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_iface.virtual import VirtualHeadset, make_defect
from firmware_iface.virtual.bench_description import ChannelDescription, IrisDescription
from firmware_iface.virtual.bench_optics import BenchOptics
from firmware_iface.virtual.iris_opening import iris_opening
from tests.firmware_iface.padded_light import samples
from tests.firmware_iface.small_bench import (
    LINEAR,
    H,
    W,
    Z,
    moments,
    quiet,
    random_gray,
    small,
    spot,
    uniform,
)


def test_vibration_widens_a_spot_along_its_direction():
    d = make_defect("vibration", rms_px=1.5, spread=0.0)
    still, moved = (moments(spot(*more).expected_counts(uniform(), "green") - 64) for more in ((), (d,)))
    np.testing.assert_allclose(still[0], moved[0], atol=1e-3)
    turn = np.deg2rad(d.direction_deg)
    expected = 1.5**2 * np.array([np.sin(turn) ** 2, np.cos(turn) ** 2, np.sin(turn) * np.cos(turn)])
    np.testing.assert_allclose(np.subtract(moved[1], still[1]), expected, atol=0.02)


def test_vibration_differs_from_capture_to_capture():
    def grown(spread):
        headset = spot(make_defect("vibration", rms_px=1.5, spread=spread))
        pictures = [headset.camera.capture() - 64.0 for _ in range(60)]
        return np.array([sum(moments(p)[1][:2]) for p in pictures])

    base = sum(moments(spot().expected_counts(uniform(), "green") - 64)[1][:2])
    assert np.ptp(grown(0.0)) < 0.02
    rms = np.sqrt(np.clip(grown(0.4) - base, 0, None))
    assert rms.mean() == pytest.approx(1.5, rel=0.15) and rms.std() == pytest.approx(0.6, rel=0.25)


def test_the_camera_moves_from_frame_to_frame():
    def centroids(seed=1, turns=60):
        headset = spot(make_defect("frame_motion", seed=seed))
        return np.array([moments(headset.camera.capture() - 64.0)[0] for _ in range(turns)])

    rest = moments(spot().expected_counts(uniform(), "green") - 64)[0]
    moved = centroids() - rest
    assert np.abs(moved.mean(0)).max() < 3 * 0.3 / np.sqrt(60)
    np.testing.assert_allclose(np.sqrt((moved**2).mean(0)), 0.3, rtol=0.25)
    assert abs(np.corrcoef(moved[1:, 0], moved[:-1, 0])[0, 1]) < 0.4
    np.testing.assert_array_equal(centroids(turns=3), centroids()[:3])
    assert np.abs(centroids(2, 3) - centroids(turns=3)).max() > 0.05


def test_the_fixed_pattern_is_in_every_capture_and_another_cameras_differs():
    plain = quiet().expected_counts(uniform(), "green") - 64
    found = []
    for seed in (1, 1, 2):
        headset = quiet(make_defect("fixed_pattern", seed=seed, offset_counts=0.0))
        headset.camera.capture()
        found.append(((headset.camera.capture() - 64.0) / plain - 1)[8:-8, 8:-8].ravel())
    assert found[0].std() == pytest.approx(0.03, rel=0.05)
    assert np.corrcoef(found[0], found[1])[0, 1] > 0.99
    assert abs(np.corrcoef(found[0], found[2])[0, 1]) < 0.08
    dark = quiet(make_defect("fixed_pattern", offset_counts=6.0))
    dark.lasers.off()
    offset = dark.camera.capture() - 64.0
    assert offset.std() == pytest.approx(6.0, rel=0.05) and abs(offset.mean()) < 0.5
    np.testing.assert_array_equal(dark.camera.capture() - 64.0, offset)


def test_several_lines_are_the_sum_of_benches_of_one():
    gray = random_gray(7)
    d = make_defect("source_lines", third_separation_nm=-5.0, third_share=0.2)
    seen = VirtualHeadset(small(d)).true_irradiance(gray, "green")
    parts = []
    for apart in (0.0, 6.0, -5.0):
        # the path difference of a gray level is the panel's: its phase is less for a longer wave
        response = make_defect("phase_response", gain=520 / (520 + apart), reference_nm=520 + apart, **LINEAR)
        bench = small(response, channels=(ChannelDescription("green", 520 + apart),))
        parts.append(VirtualHeadset(bench).true_irradiance(gray, "green"))
    expected = 0.5 * parts[0] + 0.3 * parts[1] + 0.2 * parts[2]
    np.testing.assert_allclose(seen, expected, atol=2e-3)
    assert np.abs(seen - parts[0]).max() > 0.05


def passes(iris, fy, fx, nominal="square"):
    bench = small(iris, iris=IrisDescription(nominal, 1.0))
    return float(iris_opening(bench).mask(np.array([fy]), np.array([fx]))[0, 0])


def test_the_iris_has_a_shape_sides_and_a_rotation_of_its_own():
    centred = {"half_width": 0.6, "centre_x_share": 0.0, "centre_y_share": 0.0}
    circle = make_defect("iris", shape="circle", **centred)
    assert passes(circle, 0.0, 0.55) == 1 and passes(circle, 0.55, 0.55) == 0
    assert passes(make_defect("iris", shape="square", **centred), 0.55, 0.55, "circle") == 1
    assert passes(make_defect("iris", **centred), 0.55, 0.55, "circle") == 0  # as bench.toml says
    oblong = make_defect("iris", half_width_x=0.3, **centred)
    assert passes(oblong, 0.55, 0.25) == 1 and passes(oblong, 0.25, 0.55) == 0
    ellipse = replace(oblong, shape="circle")
    assert passes(ellipse, 0.55, 0.0) == 1 and passes(ellipse, 0.55, 0.25) == 0
    turned = make_defect("iris", rotation_deg=45.0, **centred)
    assert passes(turned, 0.0, 0.8) == 1 and passes(turned, 0.55, 0.55) == 0
    # from x towards y: the long side of a slit along x points to +x, +y
    slit = make_defect("iris", rotation_deg=45.0, half_width_y=0.05, **centred)
    assert passes(slit, 0.3, 0.3) == 1 and passes(slit, 0.3, -0.3) == 0


def test_a_soft_edge_passes_half_where_a_hard_one_ends():
    soft = make_defect("iris", half_width=0.6, soft_edge_share=0.2, centre_x_share=0.1, centre_y_share=0.0)
    found = [passes(soft, 0.0, fx) for fx in (0.55, 0.65, 0.7, 0.75, 0.85)]
    assert found[0] == 1 and found[4] == 0
    assert found[1:4] == pytest.approx([0.5 + np.sqrt(0.125), 0.5, 0.5 - np.sqrt(0.125)], abs=1e-6)
    band = BenchOptics(small(soft)).path("green", Z).band
    assert 2 * band.fx[-1] >= 0.8 - 2 / band.padded[1]  # the edge's outer half is in the band


def test_what_a_round_iris_cuts_off_is_lost():
    def share(shape):
        iris = make_defect("iris", half_width=1.0, centre_x_share=0, centre_y_share=0, shape=shape)
        light, _, _, per_pixel = samples(small(iris), random_gray(8), 3.0)
        return light.sum() / per_pixel / (H * W)

    f = np.linspace(-0.5, 0.5, 401)
    power = np.sinc(f)[:, None] ** 2 * np.sinc(f)[None, :] ** 2 * (f[1] - f[0]) ** 2
    inside = np.hypot(f[:, None], f[None, :]) <= 0.5
    assert share("circle") == pytest.approx(power[inside].sum(), rel=0.03)
    assert share("square") == pytest.approx(power.sum(), rel=0.03)
