"""Shapes that change over the captures and products of two shapes, on benches that nobody described to the light path.

What `propose` ends with must be at the camera's noise, and the curve over the captures the one that was hidden.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from firmware_iface.virtual import make_defect
from tests.trainer.changing_bench import captured_while_changing
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Moment
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.addition import add
from trainer.diagnosis.probes import ProbeResult, probe
from trainer.diagnosis.proposals.effect_file import write_effect
from trainer.diagnosis.proposals.in_time import candidates_in_time
from trainer.diagnosis.proposals.order_shape import ORDER, TIME, Strengths, clock_of, curves_in
from trainer.diagnosis.proposals.probe_maps import GAIN, GRAY, OFFSET, PHASE, map_at
from trainer.diagnosis.proposals.product_shape import product, product_in, strength_of
from trainer.diagnosis.proposals.proposal_rounds import Proposal
from trainer.diagnosis.proposals.proposing import Proposals, propose
from trainer.diagnosis.proposals.reading import Reading
from trainer.diagnosis.proposals.shapes_tried import candidates_of, readings_of
from trainer.diagnosis.proposals.surface_shape import smooth_in
from trainer.diagnosis.proposals.wave_shape import waves_in
from trainer.effects import testing
from trainer.effects.effect_catalogue import catalogue, load_effects
from trainer.effects.own_effect import applied
from trainer.fitting.gains import with_gains
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.bundle_export import export_bundle
from trainer.model.model import Model, instance_with
from trainer.prediction.scene import bare_stages, scene_at

SHAPE = (72, 96)


def moments(count: int = 16, every: float = 1.0) -> tuple[Moment, ...]:
    return tuple(Moment(float(k), every * k) for k in range(count))


def strengths(curve: np.ndarray, noise: float = 0.01) -> Strengths:
    drawn = noise * np.random.default_rng(0).standard_normal(len(curve))
    return Strengths(moments(len(curve)), curve + drawn, np.ones(len(curve)))


# Curves over the captures


def test_a_line_is_read_with_its_slope() -> None:
    (size, line), *_ = curves_in(strengths(0.2 + 0.05 * np.arange(16)))
    assert line.name == "line"
    assert size == pytest.approx(0.95, abs=0.02)
    assert float(line.starts["slope"]) == pytest.approx(0.05 / 0.95, rel=0.05)


def test_what_settles_is_read_with_its_constant() -> None:
    (size, settling), *_ = curves_in(strengths(0.3 - 1.2 * np.exp(-np.arange(16) / 3)))
    assert settling.name == "settling"
    assert size == pytest.approx(-1.2, abs=0.06)
    assert float(settling.starts["settling"]) == pytest.approx(3, rel=0.1)
    assert float(settling.starts["rest"]) == pytest.approx(-0.25, abs=0.03)


def test_a_swing_about_nothing_is_read_with_its_period() -> None:
    (size, swing), *_ = curves_in(strengths(0.7 * np.cos(2 * math.pi * np.arange(16) / 5.3 + 1)))
    assert swing.name == "swing"
    assert size == pytest.approx(0.7, rel=0.03)
    assert float(swing.starts["swing"]) == pytest.approx(5.3, rel=0.02)
    assert math.remainder(float(swing.starts["begin"]) - math.degrees(1), 360) == pytest.approx(0, abs=5)
    assert float(swing.starts["rest"]) == pytest.approx(0, abs=0.03)


@pytest.mark.parametrize("seed", range(5))
def test_steady_strengths_and_strengths_without_order_have_no_curve(seed: int) -> None:
    drawn = np.random.default_rng(seed).standard_normal(16)
    assert not curves_in(Strengths(moments(), 1 + 0.3 * drawn, np.ones(16)))
    assert not curves_in(Strengths(moments(4), np.arange(4.0), np.ones(4)))


def test_uneven_captures_are_read_by_their_time() -> None:
    assert clock_of(moments(16, 0.1)) is ORDER
    paused = [Moment(float(k), 10.0 * k + (500 if k > 7 else 0)) for k in range(16)]
    assert clock_of(paused) is TIME
    curve = np.exp(-np.array([m.time_s for m in paused]) / 300)
    (_, first), *_ = curves_in(Strengths(tuple(paused), curve, np.ones(16)))
    assert first.name == "settling" and "moment.time_s" in first.code[0]
    assert float(first.starts["settling"]) == pytest.approx(300, rel=0.1)


# Products


def pixels() -> tuple[np.ndarray, np.ndarray]:
    y, x = (np.arange(n) - (n - 1) / 2 for n in SHAPE)
    grid = np.meshgrid(y, x, indexing="ij")
    return grid[0], grid[1]


def test_two_waves_are_a_product_and_a_sum_is_none() -> None:
    y, x = pixels()
    fine, coarse = np.cos(2 * math.pi * (x + 0.4 * y) / 7.1), np.cos(2 * math.pi * y / 29 + 0.4)
    noise = 0.01 * np.random.default_rng(0).standard_normal(SHAPE)
    one = map_at(GAIN, 0.1 * fine * (1 + 0.7 * coarse) + noise, SHAPE)
    best = readings_of(one)[0]
    assert best.name == "fringes_times_fringes" and best.explained > 0.95
    assert float(best.starts["fringes_period"]) == pytest.approx(29, rel=0.02)
    (first,) = waves_in(map_at(GAIN, 0.1 * fine + noise, SHAPE))
    together = map_at(GAIN, 0.1 * fine + 0.07 * coarse + noise, SHAPE)
    (surface,) = smooth_in(strength_of(together, first), 2)
    assert product_in(together, first, surface) is None


def written(place, reading: Reading, folder: Path, moment: Moment) -> np.ndarray:
    """What the file of a reading changes of the camera's gain, or of the phase at the panel, at a moment."""
    bench = testing.small_bench()
    scene = scene_at(bench, bench.channels[0].name, 10.0, "angular_spectrum", 1.0, torch.float32)
    name = f"{place.stage}_{reading.name}"
    folder.mkdir()
    write_effect(folder / f"{name}.py", name, place, reading)
    (effect,) = load_effects(folder / f"{name}.py")
    assert effect.takes_moment
    values = instance_with(effect, bench, reading.starts).values
    tensors = {n: torch.as_tensor(v, dtype=torch.float32) for n, v in values.items()}
    before = getattr(bare_stages(scene), place.stage)
    after = applied(effect, before, {**tensors, "moment": moment})
    assert testing.change_when_absent(effect) < 1e-5
    return after.gain.numpy() - 1 if place is GAIN else np.angle((after.source / before.source).numpy())


@pytest.mark.parametrize("place", [GAIN, PHASE], ids=["gain", "phase"])
def test_a_file_computes_the_shape_times_the_curve(place, tmp_path: Path) -> None:
    y, x = pixels()
    one = map_at(place, 0.1 * np.cos(2 * math.pi * x / 9.3 + 0.5) + 1e-4 * y, SHAPE)
    (wave,) = waves_in(one)
    curves = {
        "line": 0.2 + 0.05 * np.arange(16),
        "settling": 0.3 - 1.2 * np.exp(-np.arange(16) / 3),
        "swing": 0.7 * np.cos(2 * math.pi * np.arange(16) / 5.3 + 1),
    }
    for name, curve in curves.items():
        size, found = curves_in(strengths(curve, 0.0))[0]
        assert found.name == name
        whole = product(wave.scaled(size), found, size * wave.found, wave.explained)
        for k in (0, 5, 15):
            change = written(place, whole, tmp_path / f"{name}{k}", Moment(float(k), 0.0))
            off = change - curve[k] * wave.found
            assert np.abs(off - off.mean()).max() < 0.01 * np.abs(wave.found).max() + 0.01 * abs(curve[k]), (
                name
            )


# Benches


def proposed(captures: CaptureSet, drafts: Path) -> Proposals:
    """What is proposed where the catalogue has two effects only, which saves their trials."""
    few = {n: e for n, e in catalogue().items() if n in ("illumination", "stray_light")}
    with open_pool(1) as pool:
        return propose(captures, Model(captures.bench), few, pool, drafts)


def accepted(found: Proposals) -> Proposal:
    first = found.proposals[0]
    assert first.worth_adding, found.sentence
    return first


def test_fringes_that_grow_over_the_captures_end_at_the_noise(tmp_path: Path) -> None:
    captures = captured_while_changing(
        tmp_path, lambda n: (make_defect("fringes", contrast=0.05 + 0.012 * n),)
    )
    found = proposed(captures, tmp_path)
    first = accepted(found)
    assert first.name == "sensor_fringes_times_line"
    assert first.excess_after < 1e-4 < 0.01 * found.diagnosis.held_out.excess
    values = first.fitted.values
    size = math.hypot(values["cosine"], values["sine"])
    assert size == pytest.approx(0.05 + 0.012 * 16, rel=0.02)
    assert size * values["slope"] == pytest.approx(0.012, rel=0.03)
    # The file alone explains the captures to a person who adds it.
    (effect,) = load_effects(first.write(tmp_path))
    again = add(captures, Model(captures.bench), effect)
    assert again.after.excess < 1e-4


@pytest.mark.slow
def test_a_wavefront_that_swings_about_flat_is_seen_though_no_steady_probe_shows_it(tmp_path: Path) -> None:
    captures = captured_while_changing(
        tmp_path,
        lambda n: (
            make_defect("panel_wavefront", peak_to_valley_nm=120 * (1 + math.sin(2 * math.pi * n / 7.3))),
        ),
    )
    found = proposed(captures, tmp_path)
    first = accepted(found)
    assert (first.candidate.place.stage, first.name) == ("panel", "panel_phase_surface_times_swing")
    assert first.excess_after < min(3e-4, 0.02 * found.diagnosis.held_out.excess)
    assert first.fitted.values["swing"] == pytest.approx(7.3, rel=0.02)
    # At the last capture's moment it is in the bundle; where no capture is known, it is left out.
    model = with_gains(captures, Model(captures.bench, (first.fitted,)), captures.captures)
    assert export_bundle(model, captures, tmp_path / "last")["effects"] == [first.name]
    assert export_bundle(model, None, tmp_path / "never")["effects_left_out"] == [first.name]


def captured_while_warming_up(folder: Path) -> CaptureSet:
    return captured_while_changing(
        folder,
        lambda n: (
            make_defect("phase_response", gain=1 + 0.012 * (n - 8), s_curvature=0.0, lopsidedness=0.0),
        ),
    )


def test_a_panel_that_warms_up_is_seen_as_a_curve_over_gray_levels_that_changes(tmp_path: Path) -> None:
    captures = captured_while_warming_up(tmp_path)
    roles = capture_roles(captures)
    with open_pool(1) as pool:
        model = with_gains(captures, Model(captures.bench), roles.fitted)
        first, *_ = candidates_in_time(roles, model, pool, [])
    assert (first.place, first.reading.name) == (GRAY, "curve_times_line")


@pytest.mark.slow
def test_a_panel_that_warms_up_ends_at_the_noise(tmp_path: Path) -> None:
    captures = captured_while_warming_up(tmp_path)
    first = accepted(proposed(captures, tmp_path))
    assert first.name == "drive_curve_times_line"
    assert first.excess_after < 1e-4


def test_added_light_that_swings_is_read_with_its_mean(tmp_path: Path) -> None:
    captures = captured_while_changing(
        tmp_path,
        lambda n: (
            make_defect(
                "stray_light", glow_counts=60 * (1 + math.sin(2 * math.pi * n / 7.3)), second_glow_counts=0.0
            ),
        ),
    )
    model = add(captures, Model(captures.bench), catalogue()["stray_light"]).model
    with open_pool(1) as pool:
        found = candidates_in_time(capture_roles(captures), model, pool, [])
    assert (found[0].place, found[0].reading.name) == (OFFSET, "surface_times_swing")
    assert float(found[0].reading.starts["swing"]) == pytest.approx(7.3, rel=0.02)
    y, x = pixels()
    glow = np.exp(-((x / 48 - 0.5) ** 2 + (y / 36 + 0.35) ** 2) / 0.36)
    seen = np.asarray(found[0].reading.found)
    assert seen.mean() > 0 and np.corrcoef(seen.ravel(), glow.ravel())[0, 1] > 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("defect", "name"),
    [
        ({"kind": "fringes", "fade": 0.8}, "sensor_fringes_times_surface"),
        ({"kind": "stripes", "fade": 0.9}, "panel_amplitude_columns_times_surface"),
    ],
)
def test_shapes_that_fade_over_the_field_are_products(defect: dict, name: str, tmp_path: Path) -> None:
    captures = captured_while_changing(tmp_path, lambda n: (make_defect(**defect),))
    first = accepted(proposed(captures, tmp_path))
    assert first.name == name
    assert first.excess_after < 1.5e-4


@pytest.mark.slow
def test_bubbles_are_specks_times_the_gray_level(tmp_path: Path) -> None:
    bubbles = make_defect(
        "specks",
        count=4,
        places=3,
        smallest_radius_px=2.5,
        largest_radius_px=5.0,
        transmission=1.0,
        phase_deg=0.0,
        phase_gain=0.6,
    )
    captures = captured_while_changing(tmp_path, lambda n: (bubbles,))
    first = accepted(proposed(captures, tmp_path))
    assert first.name == "drive_gray_specks"
    assert first.excess_after < 3e-4
    assert float(first.fitted.values["passed"]) == pytest.approx(0.6, abs=0.01)


def test_nothing_changes_over_the_captures_of_steady_fringes(tmp_path: Path) -> None:
    captures = captured_while_changing(tmp_path, lambda n: (make_defect("fringes"),))
    roles = capture_roles(captures)
    model = with_gains(captures, Model(captures.bench), roles.fitted)
    before = evaluate_captures(captures, roles.held_out, model)
    ids, held = (tuple(c.capture for c in part) for part in (roles.probed, roles.held_out))
    seen = ProbeResult.judged(probe(captures.folder, ids, held, model, "sensor"), before)
    steady, *_ = candidates_of([seen], captures.bench, 100.0)
    assert (steady.place, steady.reading.name) == (GAIN, "fringes")
    with open_pool(1) as pool:
        assert candidates_in_time(roles, model, pool, [steady]) == []
