"""The virtual devices: noise, saturation, determinism, conventions, oracle, an independent simulation."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_iface import InputError
from firmware_iface.virtual import VirtualHeadset, load_bench, make_defect, named_benches, open_headset

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
H, W, Z = 64, 96, 12.0


def headset(name="ideal", seed=0, size=(H, W), *defects) -> VirtualHeadset:
    bench = load_bench(f"virtual:{name}").resized(*size, Z)
    return VirtualHeadset(replace(bench, defects=bench.defects + defects), seed)


def picture_gray(height=H, width=W, seed=0):
    """A pattern with broad and fine structure."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width]
    broad = 90 * np.sin(x / 11) + 80 * np.cos(y / 7 + x / 23)
    return ((broad + rng.normal(0, 45, (height, width))) % 256).astype(np.uint8)


def test_without_lasers_the_camera_sees_black_level_and_read_noise():
    dark = headset("stray_light").camera.capture().astype(float)
    assert dark.mean() == pytest.approx(64, abs=0.2)
    assert dark.std() == pytest.approx(np.hypot(5 * 4031 / 10500, 12**-0.5), rel=0.05)


def test_noise_follows_the_photon_transfer_line():
    device = headset()
    device.lasers.set_power("green", 1.0)
    device.panel.show(picture_gray())
    shots = np.array([device.camera.capture() for _ in range(60)], float)
    mean, variance = shots.mean(0) - 64, shots.var(0, ddof=1)
    slope, offset = np.polyfit(mean.ravel(), variance.ravel(), 1)
    gain = 4031 / 10500
    assert slope == pytest.approx(gain, rel=0.03)
    assert offset == pytest.approx((5 * gain) ** 2 + 1 / 12, abs=3)
    expected = device.expected_counts(picture_gray(), "green")
    assert np.abs(shots.mean(0) - expected).mean() < 1.2 * np.sqrt(variance.mean() / 60)


def test_saturation_clips_and_ordinary_exposure_hardly_does():
    device = headset()
    device.lasers.set_power("green", 1.0)
    device.panel.show(picture_gray())
    assert (device.camera.capture() == 4095).mean() < 0.003
    device.camera.exposure_ms = 300
    bright = device.camera.capture()
    assert bright.max() == 4095 and (bright == 4095).mean() > 0.2


def test_power_and_exposure_scale_the_signal():
    device = headset()
    device.panel.show(picture_gray())
    means = []
    for power, exposure in ((1.0, 5.0), (0.5, 10.0)):
        device.lasers.set_power("green", power)
        device.camera.exposure_ms = exposure
        means.append(device.camera.capture().mean() - 64)
    assert means[0] == pytest.approx(means[1], rel=0.01)
    device.lasers.off()
    assert device.camera.capture().mean() == pytest.approx(64, abs=0.3)


def test_the_same_seed_gives_the_same_captures():
    def shots(seed):
        device = headset("laser_drift", seed)
        device.lasers.set_power("green", 1.0)
        device.panel.show(picture_gray())
        return [device.camera.capture() for _ in range(2)], device.time_s

    (first, time), (again, _), (other, _) = shots(1), shots(1), shots(2)
    assert np.array_equal(first, again)
    assert not np.array_equal(first[0], first[1]) and not np.array_equal(first[0], other[0])
    assert time == pytest.approx(0.2)


def test_colours_add_up_when_two_lasers_are_on():
    device = headset("colour")
    device.panel.show(picture_gray())
    signal = {}
    for on in (("red",), ("blue",), ("red", "blue")):
        device.lasers.off()
        for name in on:
            device.lasers.set_power(name, 0.5)
        signal[on] = device.camera.capture().astype(float).mean() - 64
    assert signal["red", "blue"] == pytest.approx(signal["red",] + signal["blue",], rel=0.01)


def test_a_whole_pixels_shift_is_the_neighbouring_pixel():
    still = make_defect(
        "misregistration", shift_x_px=1, shift_y_px=-2, rotation_mrad=0, scale=1, distortion_px=0
    )
    plain = headset().expected_counts(picture_gray(), "green")
    moved = headset("ideal", 0, (H, W), still).expected_counts(picture_gray(), "green")
    np.testing.assert_allclose(moved[4:-4, 4:-4], np.roll(plain, (2, -1), (0, 1))[4:-4, 4:-4], atol=0.5)


def test_a_homography_of_the_description_places_the_camera():
    bench = load_bench("virtual:ideal").resized(H, W, Z)
    camera = replace(
        bench.camera, registered=False, homography=(-1.0, 0, W - 1.0, 0, 1.0, 0, 0, 0, 1.0)
    )  # mirrored
    seen = VirtualHeadset(replace(bench, camera=camera)).expected_counts(picture_gray(), "green")
    plain = headset().expected_counts(picture_gray(), "green")
    np.testing.assert_allclose(seen, plain[:, ::-1], atol=0.5)


def test_conventions():
    gray = picture_gray()
    plain = headset().expected_counts(gray, "green")
    mirrored = headset("ideal", 0, (H, W), make_defect("convention", flip_y=True)).expected_counts(
        gray, "green"
    )
    np.testing.assert_allclose(mirrored, plain[::-1, ::-1], rtol=1e-4)
    # a conjugate pattern seen behind the panel is the pattern seen before it
    both = make_defect("convention", mirror_x=False, phase_sign=-1, distance_sign=-1)
    np.testing.assert_allclose(
        headset("ideal", 0, (H, W), both).expected_counts(gray, "green"), plain, rtol=2e-3, atol=0.1
    )
    shifted = headset("ideal", 0, (H, W), make_defect("convention", left_justified=True)).camera.capture()
    assert shifted.max() > 1000 and not np.any(shifted % 16)


def test_camera_faults_do_not_change_what_the_eye_sees():
    gray = picture_gray()
    plain = headset().true_irradiance(gray, "green")
    for name in (
        "sensor_blur",
        "misregistration",
        "vignetting",
        "stray_light",
        "sensor_response",
        "fringes",
        "vibration",
        "frame_motion",
        "fixed_pattern",
    ):
        np.testing.assert_allclose(headset(name).true_irradiance(gray, "green"), plain)
    assert np.abs(headset("ghost").true_irradiance(gray, "green") - plain).max() > 0.05


# what shows only in how captures differ from one another
IN_ORDER = ("laser_drift", "slow_response", "frame_motion")


@pytest.mark.parametrize("name", [n for n in named_benches() if n not in ("ideal", *IN_ORDER)])
def test_every_named_bench_differs_from_the_ideal_by_more_than_noise(name):
    noise = np.random.default_rng(3).integers(0, 256, (H, W), dtype=np.uint8)
    finest = picture_gray() + 128 * (np.arange(W) % 2).astype(np.uint8)  # most light at the end of the band
    bench = load_bench(f"virtual:{name}").resized(H, W, 30.0)
    channel = bench.channels[0].name
    ideal, seen = (
        np.array(
            [VirtualHeadset(b).expected_counts(g, channel) - 64 for g in (picture_gray(), noise, finest)]
        )
        for b in (replace(bench, defects=()), bench)
    )
    scale = (seen * ideal).sum((1, 2)) / (ideal * ideal).sum((1, 2))
    excess = ((seen - scale[:, None, None] * ideal) ** 2).mean((1, 2)) / seen.var((1, 2))
    assert excess.max() > 0.01  # an iris or a line width shows only where there is fine structure


def test_laser_drift_moves_the_power():
    device = headset("laser_drift")
    device.lasers.set_power("green", 1.0)
    device.panel.show(picture_gray())
    means = np.array([device.camera.capture().mean() - 64 for _ in range(12)])
    assert 0.04 < means.std() / means.mean() < 0.5


def test_the_oracle_beats_the_ideal_models_pattern():
    y, x = np.mgrid[0:H, 0:W] / H
    target = 0.2 + 0.8 * ((np.hypot(x - 0.75, y - 0.5) < 0.3) ^ (x > 0.9))
    true = headset("demo")
    patterns = {
        "oracle": true.oracle_pattern(target, "green", iterations=40),
        "ideal": headset().oracle_pattern(target, "green", iterations=40),
    }

    def error(gray):
        a, b = np.sqrt(np.clip(true.true_irradiance(gray, "green"), 0, None)), np.sqrt(target)
        return ((a * (a * b).sum() / (a * a).sum() - b) ** 2).mean()

    assert error(patterns["oracle"]) < 0.3 * error(patterns["ideal"])


def test_devices_refuse_what_they_cannot_do():
    device = headset()
    with pytest.raises(InputError, match="uint8"):
        device.panel.show(np.zeros((H, W)))
    with pytest.raises(InputError, match=r"\(64, 96\)"):
        device.panel.show(np.zeros((W, H), np.uint8))
    with pytest.raises(InputError, match="green"):
        device.lasers.set_power("gren", 1.0)
    with pytest.raises(InputError, match="0 to 1"):
        device.lasers.set_power("green", 1.5)
    with pytest.raises(InputError, match="exposure"):
        device.camera.exposure_ms = 0
    with pytest.raises(InputError, match="plane"):
        device.move_to_plane(float("nan"))
    with pytest.raises(InputError, match="target"):
        device.oracle_pattern(np.ones((3, 3)), "green")


@pytest.mark.parametrize(
    ("practice", "name"),
    [
        pytest.param(
            practice,
            name,
            marks=pytest.mark.skipif(
                not (SHARED / "practice" / practice).is_dir(),
                reason="no practice sets beside the repository",
            ),
        )
        for practice, name in (("ideal", "ideal"), ("ripple", "phase_ripple"))
    ],
)
def test_an_independent_simulation_is_reproduced(practice, name):
    """Captures of another sub-pixel simulation: the excess over the camera's noise is below 1e-4."""
    image = pytest.importorskip("PIL.Image")
    folder = SHARED / "practice" / practice
    device = open_headset(f"virtual:{name}")
    predicted, seen = [], []
    with (folder / "captures.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            gray = np.array(image.open(folder / row["phase"]))
            predicted.append(device.true_irradiance(gray, row["channel"], float(row["plane_mm"])))
            seen.append(np.array(image.open(folder / row["image"])).astype(float))
    model, counts = np.array(predicted), np.array(seen)
    valid = counts < 4095
    model, signal = model[valid], counts[valid] - 64
    scale = (model * signal).sum() / (model * model).sum()
    gain = 4031 / 10500
    noise = gain * scale * np.clip(model, 0, None) + (5 * gain) ** 2 + 1 / 12
    excess = (((signal - scale * model) ** 2).mean() - noise.mean()) / signal.var()
    assert excess < 1e-4
