"""Maps that hide one another: what one took up while another was still polynomials is given back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from firmware_iface.virtual import BenchDescription, VirtualHeadset, make_defect
from firmware_iface.virtual.defect_kind import Defect
from trainer.captures.acquire import acquire_captures
from trainer.captures.batches import Batch, load
from trainer.captures.capture_set import read_captures
from trainer.captures.open_bench import nominal_bench
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.free_form_effects import refined, with_free_form
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.predictor import Predictor, excess_on
from trainer.model.model import Model, absent

NODES = {"rough_nodes_y": 6, "rough_nodes_x": 8}
BEAM = make_defect("illumination", waist_x_share=0.45, waist_y_share=0.45, ring=0.0, rough_rms=0.25, **NODES)
WAVEFRONT = make_defect("panel_wavefront", peak_to_valley_nm=800.0, rough_rms_rad=0.4, **NODES)
FALL_OFF = make_defect("vignetting", corner_angle_deg=45.0)


def fitted(folder: Path, *defects: Defect) -> tuple[Model, list[Batch], list[Batch]]:
    """The model of a simulated bench with the hidden effects as lowest polynomials, and captures to go on with."""
    bench = BenchDescription("rough", defects=defects).resized(72, 96, 8.0)
    headset = VirtualHeadset(bench, seed=3)
    acquire_captures(headset, nominal_bench(headset), folder / "captures", patterns=9)
    captures = read_captures(folder / "captures")
    rows = captures.captures
    model = Model(captures.bench)
    for kind in (d.kind for d in defects):
        model = model.having(absent(catalogue()[kind], captures.bench))
    model = with_gains(captures, model, rows[:5])
    first, last = load(captures, rows[:5]), load(captures, rows[5:])
    return fit(model, model.names, first).model, first, last


def test_a_rough_beam_that_is_dark_in_the_corners_and_a_rough_wavefront_end_at_the_noise(
    tmp_path: Path,
) -> None:
    model, first, last = fitted(tmp_path, BEAM, WAVEFRONT)
    assert excess_on(model, last) > 0.05
    waved = with_free_form(model, "panel_wavefront", first, last, 0.0002)
    assert waved is not None and excess_on(waved, last) > 0.02
    both = with_free_form(waved, "illumination", first, last, 0.0002)
    assert both is not None and excess_on(both, last) < 0.0004  # one after the other: 0.006


def test_the_counts_of_a_beam_at_its_limits_can_be_squared_in_single_precision(tmp_path: Path) -> None:
    """Fits try such beams on their way, and judge them by their squared errors."""
    model, first, _ = fitted(tmp_path, BEAM)
    limit = {"log_amplitude": np.full_like(model.instance("illumination").values["log_amplitude"], 12.0)}
    model = model.having(model.instance("illumination").with_values(limit))
    with torch.no_grad():
        assert bool(torch.isfinite(Predictor(model, first[0]).predict(model) ** 2).all())


def test_maps_of_different_stages_are_fitted_again_together(tmp_path: Path) -> None:
    model, first, last = fitted(tmp_path, FALL_OFF, WAVEFRONT)
    for kind in ("vignetting", "panel_wavefront"):
        model = model.having(replace(model.instance(kind), nodes=np.zeros((15, 19))))
    least = {}
    for alone in ("vignetting", "panel_wavefront"):
        other = next(n for n in model.names if n != alone)
        one = model.having(replace(model.instance(other), nodes=None))
        least[alone] = excess_on(refined(one, first, last), last)
    together = excess_on(refined(model, first, last), last)
    assert together < 0.5 * min(least.values())
    assert together == pytest.approx(0, abs=0.1 * excess_on(model, last))
