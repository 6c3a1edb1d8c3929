"""Free-form maps of wavefront and beam: found where they are, through modes, leak and crosstalk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from runtime.calibration.drift import Drift, drifted
from runtime.calibration.drift_fit import chi_squared
from runtime.calibration.estimate import ColourLightPath, Estimate, predicted, shot_of
from runtime.calibration.free_form_fit import fit_freeform
from runtime.calibration.shown_patterns import grains
from runtime.camera.view import View, sampler, sampler_and_adjoint
from runtime.lightpath.light_path import LightPath, irradiance, panel_phase
from runtime.lightpath.spline_maps import node_weights, nodes_over
from tests.runtime.benches import ideal_path, random_path
from tests.runtime.calibration.drifting import WAVELENGTH_NM, without_tilt

SHAPE = (40, 52)


def fine_map(seed: int, size: float) -> np.ndarray:
    """A smooth random surface [H, W] with structure some six pixels wide."""
    surface = gaussian_filter(np.random.default_rng(seed).normal(size=SHAPE), 3)
    return np.asarray(size * surface / surface.std())


def test_nodes_make_a_smooth_map_that_holds_every_straight_line() -> None:
    weights = node_weights(50, 15)
    assert weights.shape == (50, 15) and weights.min() >= 0
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-12)
    line = np.arange(50.0)
    left = line - weights @ np.linalg.lstsq(weights, line, rcond=None)[0]
    assert np.abs(left).max() < 1e-9


def test_a_cameras_reading_has_its_adjoint() -> None:
    path = ideal_path(SHAPE, 8e-3)
    turned = (0.9, 0.05, 2.0, -0.05, 0.9, 3.0, 0, 0, 1)
    read, back = sampler_and_adjoint(View((44, 50), turned, blur_y_px2=0.3), path.grid)
    image = irradiance(path, np.random.default_rng(5).uniform(0, 6, SHAPE))
    light = np.random.default_rng(6).normal(size=(44, 50))
    assert np.vdot(read(image), light) == pytest.approx(np.vdot(image, back(light)), rel=1e-5)


@pytest.mark.parametrize("make", [ideal_path, random_path])
def test_fine_structure_is_found_in_wavefront_and_beam(make: object) -> None:
    path: LightPath = ideal_path(SHAPE, 8e-3) if make is ideal_path else random_path(SHAPE)
    base = ColourLightPath(path, WAVELENGTH_NM)
    hidden_nm, hidden_log = fine_map(0, 15.0), fine_map(1, 0.08)
    factor = np.exp(hidden_log + 2j * np.pi / WAVELENGTH_NM * hidden_nm)
    leak = None if path.leak is None else path.leak * factor
    truth = replace(path, source=path.source * factor, leak=leak)
    start = Estimate(Drift(), View(SHAPE))
    sample = sampler(start.view, path.grid)
    shots = []
    for seed, size in enumerate((4, 2, 6, 3, 2, 5)):
        gray = grains(SHAPE, size, seed)
        seen = sample(irradiance(truth, panel_phase(truth, gray.astype(np.int64))))
        noise = (0.005 * seen.mean()) ** 2
        shots.append(shot_of("green", gray, seen, 0.0, np.full(SHAPE, 1 / noise)))
    found = fit_freeform({"green": base}, shots, start)
    assert found.drift.wavefront_nodes_nm.shape == nodes_over(SHAPE, 4)
    error = without_tilt(found.drift.wavefront(SHAPE) - hidden_nm)[4:-4, 4:-4]
    beam = (np.log(found.drift.amplitude("green", SHAPE)) - hidden_log)[4:-4, 4:-4]
    assert error.std() < 0.1 * 15.0 and beam.std() < 0.2 * 0.08
    before, after = (chi_squared({"green": base}, shots, e) for e in (start, found))
    assert after < 0.01 * before
    # and the light path that a bundle gets carries it
    put_in = drifted(path, "green", WAVELENGTH_NM, found.drift)
    one = Estimate(Drift(), start.view)
    np.testing.assert_allclose(
        predicted(ColourLightPath(put_in, WAVELENGTH_NM), shots[0], one, sample),
        predicted(base, shots[0], found, sample),
    )
