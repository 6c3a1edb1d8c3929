"""What a large panel is spared: maps where the polynomials predict well, and light that has not changed.

The rule for large panels is tried on a small one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from firmware_iface.virtual import VirtualHeadset
from firmware_iface.virtual.simulated_panel import panel_path_nm
from runtime.calibration import information
from runtime.calibration.colour_captures import colour_captures, colour_patterns
from runtime.calibration.columns import Columns
from runtime.calibration.drift import Drift
from runtime.calibration.drift_fit import DriftFit, layout_of
from runtime.calibration.estimate import ColourLightPath, Estimate, predicted, shot_of
from runtime.calibration.information import measured_information
from runtime.calibration.misfit import Misfit
from runtime.calibration.refit import refit, start_view
from runtime.calibration.shown_patterns import grains
from runtime.calibration.taking import Taker
from runtime.camera.view import View, sampler
from runtime.excess import COMPLETE_EXCESS
from runtime.lightpath.ideal_path import ideal_path, single
from runtime.lightpath.light_path import irradiance, panel_phase
from runtime.program.progress import no_progress
from tests.runtime.calibration.drifting import (
    WAVELENGTH_NM,
    base,
    blank,
    devices,
    drifted_bench,
    without_tilt,
)

SHAPE = (80, 96)


def refitted(rough_rms_rad: float) -> tuple[DriftFit, float]:
    """The refit of a headset whose wavefront has drifted, by the rule for large panels; its error, nm rms."""
    bench = drifted_bench("panel_wavefront", "distance", shape=SHAPE, rough_rms_rad=rough_rms_rad)
    taker = Taker(devices(VirtualHeadset(bench, 1)), lambda what: None)
    bases = {"green": base(SHAPE)}
    black, floor = taker.darkness()
    captures = {"green": colour_captures(taker, "green", colour_patterns(bases, 0)["green"], black, floor)}
    view, new = start_view(captures["green"], None, SHAPE, SHAPE)
    found, _ = refit(bases, captures, view, new, no_progress)
    hidden = panel_path_nm(bench.defects[0], *SHAPE, SHAPE[1] / SHAPE[0])  # type: ignore[arg-type]
    return found, float(without_tilt(found.estimate.drift.wavefront(SHAPE) - hidden).std())


@pytest.mark.usefixtures("spared_maps")
def test_a_smooth_drift_gets_no_maps_and_is_found_as_well() -> None:
    found, error = refitted(0.0)
    assert not found.estimate.drift.wavefront_nodes_nm.size
    assert error < WAVELENGTH_NM / 170


@pytest.mark.usefixtures("spared_maps")
def test_a_rough_drift_gets_maps_where_held_out_patterns_show_it() -> None:
    found, error = refitted(0.25)
    assert found.estimate.drift.wavefront_nodes_nm.size
    assert error < WAVELENGTH_NM / 170


@pytest.mark.parametrize("pixels, most", [(2, 300), (6, 250), (15, 160)])
def test_an_excess_that_is_too_little_to_matter_is_a_small_error(pixels: int, most: int) -> None:
    """Why large panels are spared maps below it: surfaces of a part of a wave leave more, the rougher the more."""
    path = base(SHAPE).path
    rough = gaussian_filter(np.random.default_rng(0).normal(size=SHAPE), pixels)
    rough -= rough.mean()
    gray = grains(SHAPE, 3, 0)
    truth = irradiance(path, panel_phase(path, gray))

    def excess(rms_waves: float) -> float:
        turn = np.exp(2j * np.pi * rms_waves * rough / rough.std()).astype(np.complex64)
        off = irradiance(replace(path, source=path.source * turn), panel_phase(path, gray))
        return float(np.mean((truth - off * np.vdot(off, truth) / np.vdot(off, off)) ** 2) / truth.var())

    assert excess(1 / most / 2) < COMPLETE_EXCESS < excess(1 / most)


def uniform(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0.5, 1.5, SHAPE).astype(np.float32)


def test_light_that_stays_is_not_propagated_again_and_gives_the_cameras_slopes() -> None:
    bases, start = {"green": base(SHAPE)}, Estimate(Drift(), View(SHAPE))
    moved = Estimate(Drift(), View(SHAPE, shift_x_px=0.2, blur_y_px2=0.1, stray=0.01))
    rng = np.random.default_rng(2)
    shots = [shot_of("green", grains(SHAPE, 3, k), uniform(rng), 0.0, uniform(rng)) for k in (0, 1)]
    whole, still = Misfit(bases, shots), Misfit(bases, shots, light=False)
    still.at(start)
    image = still.predictor.image
    still.predictor.image = lambda *_: pytest.fail("it is propagated again")  # type: ignore[method-assign]
    chi2, slopes = still.at(moved)
    still.predictor.image = image  # type: ignore[method-assign]
    wanted, full = whole.at(moved)
    assert chi2 == pytest.approx(wanted, rel=1e-5)
    for name in ("over_y", "over_x", "over_sensitivity", "blur", "stray"):
        one, other = getattr(slopes, name), getattr(full, name)
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4 * np.abs(other).max(), err_msg=name)
    assert slopes.distance == 0 and not slopes.over_panel["green"].any()


def test_colours_share_the_memory_of_their_fields_and_say_what_each_says_alone() -> None:
    colours = {"green": 520.0, "red": 638.0, "blue": 450.0}
    bases = {
        c: ColourLightPath(single(ideal_path(SHAPE, 8e-6, nm * 1e-9, 8e-3, 1.0)), nm)
        for c, nm in colours.items()
    }
    rng = np.random.default_rng(3)
    shots = [
        shot_of(c, grains(SHAPE, 3, k), uniform(rng), 0.0, uniform(rng))
        for k, c in enumerate([*colours, *colours])
    ]
    start = Estimate(Drift(distance_mm=0.05), View(SHAPE))
    together = Misfit(bases, shots)
    chi2, slopes = together.at(start)
    alone = [Misfit({c: bases[c]}, [s for s in shots if s.channel == c]).at(start) for c in colours]
    assert chi2 == pytest.approx(sum(one for one, _ in alone), rel=1e-6)
    for (_, one), colour in zip(alone, colours, strict=True):
        np.testing.assert_allclose(slopes.over_panel[colour], one.over_panel[colour], rtol=1e-4, atol=1e-2)
    assert slopes.distance == pytest.approx(sum(one.distance for _, one in alone), rel=1e-4)
    fields = [o.image_plane.fields[0] for o in together.predictor.optics.values()]
    assert np.shares_memory(fields[0], fields[1]) and np.shares_memory(fields[0], fields[2])


def test_one_colours_captures_tell_how_much_the_others_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along every direction to a factor that only costs a fit some steps."""
    bases, shots = {}, []
    for channel, nm in (("green", 520.0), ("red", 638.0), ("blue", 450.0)):
        path = single(ideal_path(SHAPE, 8e-6, nm * 1e-9, 8e-3, 1.0))
        bases[channel] = ColourLightPath(path, nm)
        for seed in range(2):
            gray = grains(SHAPE, 2 + seed, seed)
            still = Estimate(Drift(), View(SHAPE))
            seen = predicted(bases[channel], blank(gray, channel), still, sampler(still.view, path.grid))
            weight = np.full(SHAPE, 1e4 / float(seen.mean()) ** 2, np.float32)
            shots.append(shot_of(channel, gray, seen, 0.0, weight))
    layout = layout_of(bases, (4, 2), False)
    still = layout.nothing(still)
    whole = measured_information(bases, shots, still, layout, no_progress).matrix
    monkeypatch.setattr(information, "SAMPLE", 6_000)  # of 7680 pixels of a pattern
    columns, made = Columns.of, []
    monkeypatch.setattr(Columns, "of", lambda self, shot: made.append(shot.channel) or columns(self, shot))
    part = measured_information(bases, shots, still, layout, no_progress).matrix
    assert made == ["green"]
    prior = np.diag(layout.precision)
    white = np.linalg.inv(np.linalg.cholesky(whole + prior))
    spread = np.linalg.eigvalsh(white @ (part + prior) @ white.T)
    assert spread.min() > 0.3 and spread.max() < 3, (spread.min(), spread.max())
