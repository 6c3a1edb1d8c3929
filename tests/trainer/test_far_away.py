"""Several strong effects that hide one another are found together, from pictures that are smoothed less and less."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from runtime.program.progress import no_progress
from tests.trainer.hidden import bench_file
from tests.trainer.test_unregistered import PIXEL_UM, taken
from tests.trainer.test_unregistered import moved as stated_aside
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import Batch, load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.captures.smoothing import smoothed
from trainer.diagnosis.explanation import explain
from trainer.diagnosis.screen import ScreenResult
from trainer.diagnosis.screening import screen_candidates
from trainer.diagnosis.together import JointExplanation, explain_together, gets_nowhere, is_expected_somewhere
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import Catalogue, catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import HOLD, fit
from trainer.fitting.joint_start import joint_start, without_effect
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import Predictor, evaluate_captures, excess_on
from trainer.model.model import Model, absent, instance_with

NARROW_BEAM = 'kind = "illumination"\nwaist_x_share = 0.8\nwaist_y_share = 0.9'
OFF_PLANE = 'kind = "distance"\noffset_mm = 0.6'
HIDDEN = ("illumination", "distance", "phase_response", "misregistration")
STRONG_PHASE = 'kind = "phase_response"\ngain = 1.25\ns_curvature = 0.15'


def known(*names: str) -> Catalogue:
    return {name: effect for name, effect in catalogue().items() if name in names}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    """A narrow beam, a plane that is elsewhere, a wrong response and a picture that lies elsewhere."""
    folder = tmp_path_factory.mktemp("far")
    moved = 'kind = "misregistration"\nshift_x_px = 3.4\nshift_y_px = -2.6'
    bench = bench_file(folder, NARROW_BEAM, OFF_PLANE, STRONG_PHASE, moved)
    acquire_from(str(bench), folder / "captures", patterns=8)
    return read_captures(folder / "captures")


@pytest.fixture(scope="module")
def together(captures: CaptureSet) -> JointExplanation:
    """What explains them, of what is hidden in them and a leak that is not."""
    roles = capture_roles(captures)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    errors = evaluate_captures(captures, roles.held_out, ideal)
    names = known(*HIDDEN, "zero_order")
    with open_pool(1) as pool:
        found = explain_together(roles, ideal, errors, names, Thresholds(), pool)
    assert found is not None
    return found


def batches_of(captures: CaptureSet) -> list[Batch]:
    return load(captures, capture_roles(captures).fitted)


def test_smoothing_adds_variances_and_keeps_the_light() -> None:
    point = torch.zeros((1, 81, 81))
    point[0, 40, 40] = 3.0
    twice = smoothed(smoothed(point, 3.0), 4.0)
    assert float(twice.sum()) == pytest.approx(3.0, rel=1e-5)
    y, x = (torch.arange(81.0) - 40,) * 2
    for along, axis in ((y[:, None], 0), (x[None, :], 1)):
        assert float((twice[0] * along**2).sum() / 3) == pytest.approx(25, rel=0.02), axis


def test_a_prediction_of_a_smoothed_picture_is_the_smoothed_prediction(captures: CaptureSet) -> None:
    (batch,) = batches_of(captures)
    model = with_gains(captures, Model(captures.bench), capture_roles(captures).fitted)
    coarse = batch.smoothed(4.0)
    expected = smoothed(batch.mask * Predictor(model, batch).predict(model), 4.0)
    torch.testing.assert_close(Predictor(model, coarse).predict(model), expected)
    assert float(coarse.signal.std()) < 0.7 * float(batch.signal.std())


def test_no_effect_alone_gets_anywhere_and_all_together_do(
    captures: CaptureSet, together: JointExplanation
) -> None:
    roles, batches = capture_roles(captures), batches_of(captures)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    before = evaluate_captures(captures, roles.held_out, ideal).excess
    for name in HIDDEN[:2]:
        alone = fit(ideal.having(absent(catalogue()[name], captures.bench)), [name], batches).model
        assert evaluate_captures(captures, roles.held_out, alone).excess > 0.5 * before
    found = together.model
    assert evaluate_captures(captures, roles.held_out, found).excess < 0.02 * before
    assert float(found.instance("distance").values["offset"]) == pytest.approx(0.6, rel=0.05)
    assert float(found.instance("phase_response").values["gain"][0]) == pytest.approx(1.25, rel=0.05)


def test_numbers_stay_near_absent_where_pictures_cannot_tell(captures: CaptureSet) -> None:
    # Smoothed pictures hold few numbers: shift and tilt, or distance, curvature and size, do much the same to them.
    names = ("misregistration", "panel_wavefront", "distance", "zero_order", "illumination")
    coarse = [b.smoothed(8.0) for b in batches_of(captures)]
    model = with_gains(captures, Model(captures.bench), capture_roles(captures).fitted)
    for name in names:
        model = model.having(absent(catalogue()[name], captures.bench))

    def farthest(hold: float) -> float:
        found = fit(model, names, coarse, iterations=6, hold=hold).model
        moved = found.instance("misregistration").values
        return max(abs(float(moved["magnification"])) / 4, abs(float(moved["rotation"])) / 30)

    assert farthest(HOLD) < 0.5 * farthest(0.0)


def test_a_joint_start_moves_the_camera_and_does_not_tilt_the_wavefront(tmp_path: Path) -> None:
    """Smoothed pictures cannot tell the two apart; next to a blur that nothing stands for, sharp ones hardly can."""
    blurred = 'kind = "sensor_blur"\nsigma_x_px = 0.7\nsigma_y_px = 0.5'
    bent = 'kind = "panel_wavefront"\npeak_to_valley_nm = 1137\norientation_deg = 129.3'
    leaking = (
        'kind = "zero_order"\nfill_factor = 0.9272\nsurface_amplitude = 0.0809\nsurface_phase_deg = 285.8'
    )
    off = 'kind = "distance"\noffset_mm = 0.55'
    hidden = (off, bent, leaking, blurred, 'kind = "laser_drift"\nsine_share = 0.0912')
    true = taken(tmp_path, *hidden, panel=(128, 160), camera=(167, 209), degrees=0.6)
    captures = stated_aside(true, dx=1.36, dy=-1.77)
    batches = batches_of(captures)
    ideal = with_gains(captures, Model(captures.bench), capture_roles(captures).fitted)
    found = joint_start(ideal, catalogue(), batches, Thresholds().least(1.0))
    shift = found.instance("misregistration").values
    a_pixel = PIXEL_UM / 8  # of the camera, in the panel's
    assert float(shift["shift_x"]) == pytest.approx(-1.36 / a_pixel, abs=0.1)
    assert float(shift["shift_y"]) == pytest.approx(1.77 / a_pixel, abs=0.1)
    assert excess_on(found, batches) < 0.005 * excess_on(ideal, batches)


def test_what_is_not_needed_is_left_out_again(captures: CaptureSet, together: JointExplanation) -> None:
    roles = capture_roles(captures)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    before = evaluate_captures(captures, roles.held_out, ideal).excess
    assert set(together.model.names) == set(HIDDEN)
    assert [name for name, _ in together.ladder] != [] and together.ladder[-1][1].excess < 0.02 * before


@pytest.mark.parametrize(("left", "somewhere"), [(0.45, True), (0.55, False)])
def test_an_effect_that_only_takes_a_wrong_structure_away_gets_nowhere(
    left: float, somewhere: bool, captures: CaptureSet
) -> None:
    """Even light leaves an excess of 1, half of what a prediction does that is bright where the picture is dark."""
    roles = capture_roles(captures)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    errors = evaluate_captures(captures, roles.held_out, ideal)
    assert errors.excess > 1.1
    assert gets_nowhere(left, errors) is not somewhere


@pytest.mark.parametrize(
    ("left", "registered", "somewhere"), [(0.4, True, True), (0.4, False, False), (0.05, False, True)]
)
def test_where_a_camera_may_lie_elsewhere_one_effect_must_explain_nearly_all(
    left: float, registered: bool, somewhere: bool, captures: CaptureSet
) -> None:
    """A blur of the camera removes more than half of an excess that a shifted picture leaves, and is not there."""
    bench = replace(captures.bench, camera=replace(captures.bench.camera, registered=registered))
    roles = capture_roles(replace(captures, bench=bench))
    ideal = with_gains(captures, Model(captures.bench), capture_roles(captures).fitted)
    errors = evaluate_captures(captures, roles.held_out, ideal)
    blur = ScreenResult("sensor_blur", absent(catalogue()["sensor_blur"], captures.bench), 1.2, left)
    assert is_expected_somewhere(roles, [blur], errors) is somewhere


def test_effects_are_fitted_together_where_one_alone_does_less_than_the_screen_expected(
    captures: CaptureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    class AllTogetherError(Exception):
        """Effects were about to be fitted together."""

    def together(*_: object) -> None:
        raise AllTogetherError

    def hopeful(*arguments: Any) -> list[ScreenResult]:
        return [replace(s, after=0.1 * s.before) for s in screen_candidates(*arguments)]

    monkeypatch.setattr("trainer.diagnosis.way.screen_candidates", hopeful)
    monkeypatch.setattr("trainer.diagnosis.way.explain_together", together)
    with open_pool(1) as pool, pytest.raises(AllTogetherError):
        explain(captures, Model(captures.bench), known("distance", "phase_response"), pool)


def test_one_strong_effect_alone_is_not_far_away(tmp_path: Path) -> None:
    acquire_from(str(bench_file(tmp_path, OFF_PLANE)), tmp_path / "captures")
    captures = read_captures(tmp_path / "captures")
    roles = capture_roles(captures)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    errors = evaluate_captures(captures, roles.held_out, ideal)
    with open_pool(1) as pool:
        screened = screen_candidates(roles, ideal, known("distance", "illumination"), pool, no_progress)
    assert not gets_nowhere(min(s.after for s in screened), errors)


def test_what_was_taken_for_a_moved_camera_is_given_back_to_the_wavefront(tmp_path: Path) -> None:
    acquire_from(str(bench_file(tmp_path, 'kind = "panel_wavefront"')), tmp_path / "captures")
    captures = read_captures(tmp_path / "captures")
    batches = [b.only([0, 1]) for b in batches_of(captures)]
    bent = with_gains(captures, Model(captures.bench), capture_roles(captures).fitted)
    bent = bent.having(absent(catalogue()["panel_wavefront"], captures.bench, 4))
    right = fit(bent, bent.names, batches)
    moved = bent.having(instance_with(catalogue()["misregistration"], captures.bench, {"shift_y": -4.0}))
    for sigma in (4.0, 2.0, 1.0):  # the wavefront alone: a tilt brings the picture back
        moved = fit(moved, ["panel_wavefront"], [b.smoothed(sigma) for b in batches]).model
    wrong = moved.without("misregistration")
    assert fit(wrong, wrong.names, batches).errors.excess > 10 * right.errors.excess
    found = without_effect(moved, "misregistration", known(), batches)
    assert excess_on(found, batches) < 1.2 * right.errors.excess


def test_what_was_taken_for_a_bent_panel_is_given_back_to_the_distance(tmp_path: Path) -> None:
    """A curvature and another magnification do nearly what another distance does."""
    captures = taken(tmp_path, OFF_PLANE, panel=(128, 160), camera=(167, 209))
    batches = [b.only([0, 1]) for b in batches_of(captures)]
    wrong = with_gains(captures, Model(captures.bench), capture_roles(captures).fitted)
    for name in ("misregistration", "panel_wavefront"):
        wrong = wrong.having(absent(catalogue()[name], captures.bench))
    for sigma in (4.0, 2.0, 1.0):
        wrong = fit(wrong, wrong.names, [b.smoothed(sigma) for b in batches]).model
    wrong = fit(wrong, wrong.names, batches).model
    found = without_effect(wrong, "panel_wavefront", catalogue(), batches)
    assert set(found.names) == {"misregistration", "distance"}
    assert float(found.instance("distance").values["offset"]) == pytest.approx(0.6, abs=0.01)
    assert float(found.instance("misregistration").values["magnification"]) == pytest.approx(0, abs=0.1)
    assert excess_on(found, batches) < 0.2 * excess_on(wrong, batches)


@pytest.mark.slow
def test_a_camera_in_its_place_is_not_moved(tmp_path: Path) -> None:
    bent = 'kind = "panel_wavefront"\npeak_to_valley_nm = 900'
    hidden = (NARROW_BEAM, OFF_PLANE, STRONG_PHASE, bent, 'kind = "zero_order"', 'kind = "laser_drift"')
    bench = bench_file(tmp_path, *hidden, width=160, height=128, distance_mm=15)
    acquire_from(str(bench), tmp_path / "captures")
    captures = read_captures(tmp_path / "captures")
    with open_pool(1) as pool:
        found = explain(captures, Model(captures.bench), catalogue(), pool)
    expected = {"illumination", "distance", "phase_response", "panel_wavefront", "zero_order", "laser_drift"}
    assert set(found.model.names) == expected
    assert found.diagnosis.verdict == "complete"


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [(), ("zero_order", "laser_drift"), ("sensor_response",)],
    ids=["five effects", "seven effects", "five effects and a bent response"],
)
def test_effects_behind_an_unregistered_camera_are_found_whole(more: tuple[str, ...], tmp_path: Path) -> None:
    bent = 'kind = "panel_wavefront"\npeak_to_valley_nm = 900'
    hidden = (NARROW_BEAM, OFF_PLANE, STRONG_PHASE, bent, *(f'kind = "{name}"' for name in more))
    taken(tmp_path, *hidden, panel=(128, 160), camera=(167, 209))
    path = tmp_path / "captures" / "bench.toml"
    stated = np.array(read_captures(path.parent).bench.camera.homography)
    angle = np.deg2rad(0.6)
    off = np.eye(3)
    off[:2, :2] = 1.006 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    off[:2, 2] = np.array([79.5, 63.5]) - off[:2, :2] @ [79.5, 63.5] + [2.5, -3.5]
    path.write_text(re.sub(r"homography = .*", f"homography = {(off @ stated).tolist()}", path.read_text()))
    captures = read_captures(path.parent)
    with open_pool(1) as pool:
        found = explain(captures, Model(captures.bench), catalogue(), pool)
    expected = {"illumination", "distance", "phase_response", "panel_wavefront", "misregistration"}
    assert set(found.model.names) == expected | set(more)
    assert found.diagnosis.verdict == "complete"
    assert float(found.model.instance("distance").values["offset"]) == pytest.approx(0.6, abs=0.02)


@pytest.mark.slow
def test_what_no_effect_explains_is_not_given_to_effects_that_are_not_there(tmp_path: Path) -> None:
    """Specks stay, and a slow panel and vibration are not among the effects that are tried together."""
    hidden = {
        "distance": "offset_mm = 0.33",
        "misregistration": "shift_x_px = -0.27\nshift_y_px = 0.15\nrotation_mrad = -1.5\nscale = 1.001",
        "slow_response": "share = 0.127",
        "vibration": "rms_px = 0.52",
        "specks": "",
    }
    defects = [f'kind = "{kind}"\n{values}' for kind, values in hidden.items()]
    bench = bench_file(tmp_path, *defects, width=320, height=240, distance_mm=30, iris=("circle", 1.0))
    acquire_from(str(bench), tmp_path / "captures", patterns=12)
    captures = read_captures(tmp_path / "captures")
    with open_pool(1) as pool:
        found = explain(captures, Model(captures.bench), catalogue(), pool)
    assert set(found.model.names) == {"distance", "misregistration", "slow_response", "vibration"}
    assert found.diagnosis.verdict == "outside_catalogue"
    assert found.diagnosis.stage == "panel"
