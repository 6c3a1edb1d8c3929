"""Cameras that do not look at the panel's own pixels, or see unevenly; and several colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from firmware_iface.virtual import BenchDescription, VirtualHeadset
from firmware_iface.virtual.bench_description import ChannelDescription
from firmware_iface.virtual.simulated_panel import panel_path_nm
from runtime.bundle.bundle_folder import Bundle, read_bundle, write_bundle
from runtime.bundle.light_path_arrays import load_light_path, pack_light_paths
from runtime.calibration.bundle_replacement import replace_bundle
from runtime.calibration.self_calibration import calibrate
from runtime.calibration.summary import numbers, sentence_of
from runtime.camera.registration import panel_points
from runtime.camera.view import View, on_panel, sampler, view_of
from runtime.lightpath.legendre import edge_to_edge
from runtime.lightpath.light_path import LightPath
from tests.runtime.benches import ideal_path
from tests.runtime.calibration.drifting import (
    DISTANCE_MM,
    drifted_bench,
    ideal_bundle,
    opened,
    without_tilt,
)

SHAPE = (64, 80)


def read_bundle_of(path: LightPath) -> Bundle:
    """A bundle of one light path, without a folder."""
    records, arrays = pack_light_paths([("green", DISTANCE_MM, 520.0, path)])
    return Bundle({"paths": records, "distance_mm": DISTANCE_MM}, arrays, {})


def turned_camera(bench: BenchDescription, degrees: float = 4.0, scale: float = 0.8) -> BenchDescription:
    """The bench with a camera of its own pixels, mirrored, turned and finer than the panel's."""
    height, width = 88, 112
    a = np.deg2rad(degrees)
    matrix = np.eye(3)
    matrix[:2, :2] = scale * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ np.diag([-1, 1])
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    matrix[:2, 2] = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2]) - matrix[:2, :2] @ centre + (0.7, -0.4)
    camera = replace(
        bench.camera,
        width=width,
        height=height,
        pixel_um=8.0 * scale,
        registered=False,
        homography=tuple(float(v) for v in matrix.ravel()),
    )
    return replace(bench, camera=camera)


@pytest.mark.slow
def test_a_mirrored_turned_and_finer_camera_is_found_by_its_dots_and_remembered(tmp_path: Path) -> None:
    bench = turned_camera(drifted_bench("panel_wavefront", shape=SHAPE))
    folder = ideal_bundle(tmp_path / "bundle", SHAPE)
    bundle = read_bundle(folder)
    found = calibrate(opened(VirtualHeadset(bench, 1)), bundle)
    assert found.verdict == "recalibrated" and found.after.errors.excess < 0.001
    truth = np.array(bench.camera.homography).reshape(3, 3)
    corners = np.array([[0, 0], [111, 0], [0, 87], [111, 87]], float)
    away = panel_points(found.estimate.view.matrix(SHAPE), corners) - panel_points(truth, corners)
    assert (
        np.hypot(*(away - away.mean(0)).T).max() < 0.1
    )  # except for a shift, which looks the same as a tilt
    # its scale came from the dots, so defocus and distance are known together only: astigmatism and more are
    wavefront = without_tilt(found.estimate.drift.wavefront(SHAPE))
    hidden = without_tilt(panel_path_nm(bench.defects[0], *SHAPE, SHAPE[1] / SHAPE[0]))  # type: ignore[arg-type]
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing="ij")
    bowl = without_tilt(y**2 * SHAPE[0] ** 2 + x**2 * SHAPE[1] ** 2).ravel()
    error = (wavefront - hidden).ravel()
    error -= bowl * (bowl @ error) / (bowl @ bowl)
    assert error.std() < 520 / 170 < hidden.std()

    replace_bundle(folder, bundle, found)
    assert view_of(read_bundle(folder)) == found.estimate.view


@pytest.mark.slow
def test_a_cameras_scale_and_distortion_are_not_put_into_the_light_path() -> None:
    """A scale that is off looks like defocus and distance, exactly; a distortion does not, and is found."""
    shape = (80, 96)
    bench = drifted_bench("misregistration", shape=shape, scale=1.001, distortion_px=0.3)
    bundle = read_bundle_of(ideal_path(shape, DISTANCE_MM * 1e-3, dtype=np.float32))
    found = calibrate(opened(VirtualHeadset(bench, 1)), bundle)
    assert found.verdict == "unchanged" and found.camera_scale == pytest.approx(0.001, rel=0.1)
    assert found.estimate.view.distortion == pytest.approx(0.3 / np.hypot(*shape) * 2, rel=0.1)
    said = sentence_of(numbers(found), False)
    assert "camera's scale is off by +0.0010" in said and "defocus and distance" in said
    # except for that defocus there is no wavefront
    left = without_tilt(found.estimate.drift.wavefront(shape))
    y, x = (n * v for n, v in zip(shape, edge_to_edge(shape), strict=True))
    bowl = without_tilt(y**2 + x**2)
    assert (left - bowl * float((bowl * left).sum() / (bowl**2).sum())).std() < 520 / 170


def test_a_capture_is_brought_onto_the_panel_through_a_bent_view() -> None:
    path = ideal_path(SHAPE, 8e-3)
    image = gaussian_filter(np.random.default_rng(0).random(path.grid.image_shape), 5)
    bent = View(SHAPE, shift_x_px=0.3, rotation_mrad=3.0, distortion=0.01)
    wanted = sampler(View(SHAPE), path.grid)(image)
    seen = on_panel(sampler(bent, path.grid)(image), bent, SHAPE)
    inside = (slice(4, -4), slice(4, -4))
    assert np.abs(seen - wanted)[inside].max() < 0.02 * np.ptp(wanted)


def test_what_the_camera_alone_does_never_reaches_the_headset() -> None:
    """Fall-off, blur and laser drift explain the captures; the light path must not change by them."""
    shape = (80, 96)
    bench = drifted_bench("vignetting", "sensor_blur", "laser_drift", shape=shape)
    bundle = read_bundle_of(ideal_path(shape, DISTANCE_MM * 1e-3, dtype=np.float32))
    found = calibrate(opened(VirtualHeadset(bench, 1)), bundle)
    assert found.verdict == "unchanged"
    drift, view = found.estimate.drift, found.estimate.view
    assert drift.wavefront(shape).std() < 520 / 170 and abs(drift.distance_mm) < 0.005
    assert np.log(drift.amplitude("green", shape)).std() < 0.03
    assert np.ptp(view.evenness()) > 0.3 and view.blur_x_px2 > view.blur_y_px2 > 0.1
    assert found.counts_per_ms["green"][1] > 0.05  # the changing power is found


COLOURS = {"red": 638.0, "green": 520.0, "blue": 450.0}


def bundle_of_three(folder: Path) -> Bundle:
    """An ideal bundle of three colours, in a folder."""
    paths = []
    for name, wavelength in COLOURS.items():
        from tests.runtime import benches

        before, benches.WAVELENGTH = benches.WAVELENGTH, wavelength * 1e-9
        paths.append((name, DISTANCE_MM, wavelength, ideal_path(SHAPE, DISTANCE_MM * 1e-3, dtype=np.float32)))
        benches.WAVELENGTH = before
    records, arrays = pack_light_paths(paths)
    write_bundle(folder, arrays, {"paths": records, "distance_mm": DISTANCE_MM}, {})
    return read_bundle(folder)


def bench_of_three(*defects: str, **parameters: float) -> BenchDescription:
    """A bench of the same colours with defects; parameters go to the first."""
    bench = drifted_bench(*defects, shape=SHAPE, **parameters)
    return replace(bench, channels=tuple(ChannelDescription(n, w) for n, w in COLOURS.items()))


@pytest.mark.slow
def test_lasers_that_point_apart_are_found(tmp_path: Path) -> None:
    """Green by 0.1 mrad and blue by 0.2 against red: with one wavefront for all, all of 0.0069 is left."""
    bundle = bundle_of_three(tmp_path / "bundle")
    bench = bench_of_three("laser_alignment", tilt_x_mrad=0.1, tilt_y_mrad=-0.06)
    found = calibrate(opened(VirtualHeadset(bench, 1)), bundle)
    assert found.verdict == "recalibrated" and found.complete
    half = [4.0 * n for n in SHAPE]  # of the panel, um: mrad times um are nm
    for k, name in enumerate(COLOURS):
        y, x, *focus = found.estimate.drift.laser_nm[name]
        assert abs(y + 0.06 * k * half[0]) < 0.02 * half[0] and abs(x - 0.1 * k * half[1]) < 0.02 * half[1]
        assert np.abs(focus).max() < 1.0
    assert numbers(found)["channels"]["blue"]["laser_terms_nm"] == pytest.approx(
        list(found.estimate.drift.laser_nm["blue"])
    )
    assert numbers(found)["channels"]["green"]["laser_tilt_mrad"] == pytest.approx([-0.06, 0.1], abs=0.002)
    replace_bundle(tmp_path / "bundle", bundle, found)
    turned = load_light_path(read_bundle(tmp_path / "bundle"), "blue").source
    slope = np.angle(np.vdot(turned[:, :-1], turned[:, 1:])) / (2 * np.pi) * 450  # nm a pixel
    assert slope == pytest.approx(0.2 * 8, abs=0.1)


@pytest.mark.slow
def test_three_colours_share_one_wavefront(tmp_path: Path) -> None:
    folder, colours = tmp_path / "bundle", COLOURS
    bundle, bench = bundle_of_three(folder), bench_of_three("panel_wavefront", "phase_response")
    found = calibrate(opened(VirtualHeadset(bench, 1)), bundle)
    assert found.verdict == "recalibrated" and found.complete
    hidden = panel_path_nm(bench.defects[0], *SHAPE, SHAPE[1] / SHAPE[0])  # type: ignore[arg-type]
    assert without_tilt(found.estimate.drift.wavefront(SHAPE) - hidden).std() < 450 / 170
    replace_bundle(folder, bundle, found)
    full = [float(np.ptp(load_light_path(read_bundle(folder), c).response)) for c in colours]
    assert full[0] < full[1] < full[2]  # liquid crystal delays blue most


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.25, 0.5])
def test_a_real_panels_shape_is_found_to_a_170th_of_a_wave(shared: Path, share: float) -> None:
    """The wavefront and the beam of a Santec panel as its owner measured them; a share of the former is the drift.

    A dozen Legendre orders alone leave an 80th and a 50th of a wave; the free-form maps hold the rest.
    """
    file = shared / "real" / "bench_field" / "santec_wavefront_calibration.npz"
    if not file.is_file():
        pytest.skip("no measurement of a real bench here")
    restoration = pytest.importorskip("skimage.restoration")
    shape, wavelength, fine = (96, 128), 520.0, 4

    def resized(surface: np.ndarray, times: int) -> np.ndarray:
        size = (shape[1] * times, shape[0] * times)
        picture = Image.fromarray(surface.astype(np.float32)).resize(size, Image.Resampling.BICUBIC)
        return np.asarray(picture, float)

    with np.load(file) as measured:  # without the border and the corners, which had no light
        phase = restoration.unwrap_phase(measured["phase_rad"][61:-61, 101:-101].astype(float))
        beam = np.clip(resized(measured["amplitude_smooth"][12:-12, 20:-20], fine), 0.05, None)
    phase = share * gaussian_filter(phase, 20)  # finer than that is the measurement's own superpixels
    headset = VirtualHeadset(drifted_bench(shape=shape), 1)
    surface = headset._optics.surface(wavelength)
    turned = np.exp(1j * without_tilt(resized(phase, fine)))
    surface.lit = (beam / np.sqrt(np.mean(beam**2)) * turned).astype(np.complex64)
    bundle = read_bundle_of(ideal_path(shape, DISTANCE_MM * 1e-3, dtype=np.float32))
    found = calibrate(opened(headset), bundle)
    hidden = without_tilt(resized(phase, 1)) * wavelength / (2 * np.pi)
    error = without_tilt(found.estimate.drift.wavefront(shape) - hidden)
    assert found.verdict == "recalibrated" and found.after.errors.excess < 0.005 * found.before.errors.excess
    assert error.std() < wavelength / 170 < hidden.std() / 20
    assert found.estimate.drift.wavefront_nodes_nm.size
    before, after = (found.pictures["green"][name][1] for name in ("before", "after"))
    assert after > before + 8
