"""The fit of what drifts by slopes and a sample: its slopes are right, the truth is found, and memory stays small."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from runtime.calibration import information
from runtime.calibration.drift import Drift
from runtime.calibration.drift_fit import chi_squared, fit, layout_of
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, predicted, shot_of
from runtime.calibration.free_form_fit import spacings
from runtime.calibration.information import measured_information
from runtime.calibration.misfit import Misfit
from runtime.calibration.parameter_layout import ParameterLayout
from runtime.calibration.prediction import Predictor
from runtime.calibration.refit import few
from runtime.calibration.shown_patterns import grains
from runtime.camera.reading import Reading
from runtime.camera.view import View, sampler
from runtime.lightpath.legendre import legendre_map_by_map, legendre_maps, legendre_moments
from runtime.lightpath.light_path import LightPath, irradiance, panel_phase
from runtime.program.progress import no_progress
from tests.runtime.benches import ideal_path, random_path
from tests.runtime.calibration.drifting import WAVELENGTH_NM, blank, without_tilt

SMALL = (40, 52)
BUNDLES = {
    "ideal": ideal_path(SMALL, 8e-3),
    "half open": ideal_path(SMALL, 8e-3, 0.5),
    "everything": random_path(SMALL),
}


def moved_at_random(layout: ParameterLayout, shape: tuple[int, int], size: float = 0.02) -> Estimate:
    """An estimate whose every number is off."""
    step = size * np.random.default_rng(2).normal(size=int(layout.edges[-1]))
    return layout.moved(layout.nothing(Estimate(Drift(), View(shape))), step)


def shots_of(path: LightPath, truth: Estimate, count: int, noise: float = 0.01) -> list[Shot]:
    """Captures of random grains at the truth, with noise."""
    base, shape = ColourLightPath(path, WAVELENGTH_NM), path.grid.shape
    sample, rng, shots = sampler(truth.view, path.grid), np.random.default_rng(3), []
    for seed in range(count):
        gray = grains(shape, 2 + seed % 4, seed)
        seen = predicted(base, blank(gray), truth, sample)
        deviation = noise * float(seen.mean())
        signal = (seen + deviation * rng.normal(size=seen.shape)).astype(np.float32)
        shots.append(shot_of("green", gray, signal, 0.0, np.full(seen.shape, 1 / deviation**2)))
    return shots


@pytest.mark.parametrize("path", BUNDLES.values(), ids=BUNDLES)
def test_a_prediction_in_place_is_the_prediction(path: LightPath) -> None:
    base = ColourLightPath(path, WAVELENGTH_NM)
    estimate = moved_at_random(layout_of({"green": base}, (3, 2), True), SMALL)
    shot = blank(grains(SMALL, 3, 0))
    predictor = Predictor({"green": base})
    predictor.take(estimate)
    wanted = predicted(base, shot, estimate, sampler(estimate.view, path.grid))
    np.testing.assert_allclose(predictor.light(shot), wanted, atol=1e-5 * wanted.max())


@pytest.mark.parametrize("new_view", [False, True])
@pytest.mark.parametrize("path", BUNDLES.values(), ids=BUNDLES)
def test_slopes_are_what_differences_of_chi_squared_say(path: LightPath, new_view: bool) -> None:
    """Along random directions of each group of numbers, with modes, states, leak and crosstalk at once."""
    bases = {"green": ColourLightPath(path, WAVELENGTH_NM)}
    layout = layout_of(bases, (4, 3), new_view)
    start = moved_at_random(layout, SMALL)
    shots = shots_of(path, Estimate(Drift(wavefront_nm=np.full(7, 20.0)), View(SMALL)), 2)
    chi2, slopes = Misfit(bases, shots).at(start)
    assert chi2 == pytest.approx(chi_squared(bases, shots, start), rel=1e-6)
    gradient = layout.gradient(slopes, {"green": WAVELENGTH_NM}, layout.levers(start.view, SMALL))
    rng = np.random.default_rng(4)
    stretch = range(layout.edges[3] + 6, layout.edges[3] + len(layout.view))
    groups = [range(a, b) for a, b in zip(layout.edges[:-1], layout.edges[1:], strict=True)]
    for group in [*groups[:3], [k for k in groups[3] if k not in stretch], *([stretch] if new_view else [])]:
        step = np.zeros(len(gradient))
        step[list(group)] = rng.normal(size=len(group)) * (0.3 if group is groups[0] else 1e-3)
        if group is stretch:
            step /= 10
        above, below = (chi_squared(bases, shots, layout.moved(start, s * step)) for s in (1, -1))
        # against what the cost could change by along so long a step, for a slope that is nearly 0
        assert (above - below) / 2 == pytest.approx(float(gradient @ step), rel=0.03, abs=2e-4 * chi2)


def test_slopes_over_a_lasers_own_wavefront_are_what_differences_of_chi_squared_say() -> None:
    bases, shots = {}, []
    for channel, nm in (("red", 638.0), ("green", 520.0)):
        path = ideal_path(SMALL, 8e-3)
        bases[channel] = ColourLightPath(path, nm)
        shots += [
            replace(shot, channel=channel)
            for shot in shots_of(path, Estimate(Drift(wavefront_nm=np.full(7, 20.0)), View(SMALL)), 2)
        ]
    layout = layout_of(bases, (4, 3), False)
    start = moved_at_random(layout, SMALL)
    chi2, slopes = Misfit(bases, shots).at(start)
    wavelengths = {c: b.wavelength_nm for c, b in bases.items()}
    gradient = layout.gradient(slopes, wavelengths, layout.levers(start.view, SMALL))
    step = np.zeros(len(gradient))
    own = int(layout.edges[1]) + layout.block + layout.amplitude
    step[own : own + layout.laser] = np.random.default_rng(4).normal(size=layout.laser) * 0.3
    above, below = (chi_squared(bases, shots, layout.moved(start, s * step)) for s in (1, -1))
    assert (above - below) / 2 == pytest.approx(float(gradient @ step), rel=0.03, abs=2e-4 * chi2)
    assert (
        layout.precision[layout.edges[1] + layout.amplitude] > 1e20
    )  # the first laser is what others differ from


def test_a_reading_has_its_adjoint_and_moves_as_its_camera_does() -> None:
    path = ideal_path(SMALL, 8e-3)
    image = irradiance(path, np.random.default_rng(5).uniform(0, 6, SMALL)).astype(np.float32)
    turned = (0.9, 0.05, 2.0, -0.05, 0.9, 3.0, 0, 0, 1)
    light = np.random.default_rng(6).normal(size=(44, 50)).astype(np.float32)

    def reading(**fields: float) -> Reading:
        return Reading(View((44, 50), turned, **fields), path.grid, slopes=True)  # type: ignore[arg-type]

    still = reading(blur_y_px2=0.3)
    seen = still.read(image)
    np.testing.assert_allclose(seen, sampler(still.view, path.grid)(image), atol=1e-5 * seen.max())
    down, right = still.motion()
    blurred = still.blurred()[1]
    still.read(image)
    back, (_, of_blur) = still.adjoint(light)
    assert np.vdot(seen, light) == pytest.approx(np.vdot(image, back), rel=1e-4)
    assert of_blur == pytest.approx(float(np.vdot(blurred, light)), rel=1e-3)
    inside = (slice(2, -2), slice(2, -2))
    for field, slope, step in (
        ("shift_y_px", down, 0.01),
        ("shift_x_px", right, 0.01),
        ("blur_x_px2", blurred, 0.01),
    ):
        more, less = (reading(**{"blur_y_px2": 0.3, field: s * step}).read(image) for s in (1, -1))
        wanted = ((more - less) / (2 * step))[inside]
        assert np.abs(slope[inside] - wanted).max() < 0.01 * np.abs(wanted).max(), field


def test_a_sample_of_the_pixels_tells_what_all_would(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along every direction, also those in which wavefront, distance and camera look nearly alike."""
    shape = (96, 112)
    path = ideal_path(shape, 8e-3, dtype=np.float32)
    bases = {"green": ColourLightPath(path, WAVELENGTH_NM)}
    layout = layout_of(bases, (4, 2), False)
    still = layout.nothing(Estimate(Drift(), View(shape)))
    shots = shots_of(path, still, 3)
    whole = measured_information(bases, shots, still, layout, no_progress).matrix
    monkeypatch.setattr(information, "SAMPLE", 6_000)  # of 32 256
    part = measured_information(bases, shots, still, layout, no_progress).matrix
    prior = np.diag(layout.precision)
    white = np.linalg.inv(np.linalg.cholesky(whole + prior))
    spread = np.linalg.eigvalsh(white @ (part + prior) @ white.T)
    assert spread.min() > 0.5 and spread.max() < 2


def test_the_truth_is_found_from_a_sample_in_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drift to order 8, with a normal matrix from few pixels, in half of what all pixels' columns take."""
    shape = (120, 160)
    path = ideal_path(shape, 8e-3, dtype=np.float32)
    bases = {"green": ColourLightPath(path, WAVELENGTH_NM)}
    rng = np.random.default_rng(7)
    wavefront, beam = 20 * rng.normal(size=42), 0.03 * rng.normal(size=14)
    drift = Drift(wavefront, {"green": beam}, 0.05)
    shots = shots_of(path, Estimate(drift, View(shape, shift_x_px=0.1, rotation_mrad=0.3)), 8)
    monkeypatch.setattr(information, "SAMPLE", 8_000)  # of 153 600
    tracemalloc.start()
    found = fit(bases, shots, Estimate(Drift(), View(shape)), (8, 4))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    error = without_tilt(found.estimate.drift.wavefront(shape) - drift.wavefront(shape))
    assert (
        without_tilt(drift.wavefront(shape)).std() > WAVELENGTH_NM / 40 and error.std() < WAVELENGTH_NM / 1500
    )
    assert found.estimate.drift.distance_mm == pytest.approx(0.05, abs=5e-4)
    assert found.estimate.view.rotation_mrad == pytest.approx(0.3, abs=0.01)
    assert found.chi2 == pytest.approx(1, abs=0.05)
    columns_bytes = (wavefront.size + beam.size) * 8 * sum(shot.signal.size for shot in shots)
    assert peak < 0.5 * columns_bytes, peak / columns_bytes


def test_maps_of_terms_one_by_one_are_the_stack_and_their_moments_its_products() -> None:
    y, x = np.meshgrid(*((2 * np.arange(n) + 1) / n - 1 for n in SMALL), indexing="ij")
    stack = legendre_maps(y, x, 5, 2)
    np.testing.assert_allclose(list(legendre_map_by_map(SMALL, 5, 2)), stack, atol=1e-6)
    values = np.random.default_rng(8).normal(size=SMALL)
    np.testing.assert_allclose(legendre_moments(values, 5, 2), np.tensordot(stack, values, 2), rtol=1e-9)


def test_large_panels_are_fitted_to_fewer_patterns_which_take_turns_and_small_ones_to_all() -> None:
    small, large = (
        [
            shot_of("green", np.zeros((1, 1), np.uint8), np.full(shape, k, np.float32), 0.0, np.ones(shape))
            for k in range(10)
        ]
        for shape in ((96, 128), (1000, 1000))
    )
    assert len(few(small, 1_000_000)) == 10
    turns = [[int(s.signal[0, 0]) for s in few(large, 4_000_000, turn)] for turn in range(3)]
    assert turns == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 0, 1]]
    assert spacings((96, 128), 3) == [4, 4, 4] and spacings((1080, 1920), 3) == [45, 22.5, 11.25]


def test_phases_of_gratings_are_the_same_from_one_propagation_as_from_one_each() -> None:
    """With an uneven gain of 1, each grating is predicted for itself; without, all follow from one."""
    from dataclasses import replace

    from runtime.calibration.response import SWEEP, measured_sweep
    from runtime.calibration.shown_patterns import grating

    path = ideal_path(SMALL, 8e-3, dtype=np.float32)
    true = (1.15 * path.response).astype(np.float32)
    still = Estimate(Drift(), View(SMALL))
    sample = sampler(still.view, path.grid)
    shots = []
    for gray in SWEEP:
        pattern = grating(SMALL, 8, gray)
        seen = sample(
            irradiance(replace(path, response=true), panel_phase(replace(path, response=true), pattern))
        )
        shots.append(shot_of("green", pattern, seen.astype(np.float32), 0.0, np.ones(SMALL)))
    sweeps = []
    for one in (path, replace(path, gain=np.ones(SMALL, np.float32))):
        predictor = Predictor({"green": ColourLightPath(one, WAVELENGTH_NM)})
        predictor.take(still)
        sweeps.append(measured_sweep(predictor, shots))
    np.testing.assert_allclose(sweeps[0].phase, true[sweeps[0].gray] - true[0], atol=2e-3)
    np.testing.assert_allclose(sweeps[1].phase, sweeps[0].phase, atol=2e-3)
    np.testing.assert_allclose(sweeps[1].visibility, sweeps[0].visibility, rtol=1e-3)
