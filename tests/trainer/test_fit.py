"""The fit: true values within their stated errors, orders raised as far as the data ask, ranges kept."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from runtime.lightpath.legendre import legendre_count
from runtime.program.plain_values import plain
from tests.trainer.hidden import bench_file
from tests.trainer.made_sets import make_set
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import Batch, load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.effects import catalogue
from trainer.effects.definition import Parameter, effect
from trainer.effects.testing import captures_with
from trainer.fitting import gauss_newton, jacobian
from trainer.fitting.further_numbers import with_numbers_that_pay
from trainer.fitting.gauss_newton import ROUGH, fit, is_too_slow
from trainer.fitting.jacobian import follow
from trainer.fitting.predictor import Predictor
from trainer.fitting.refit import least_for_order, raise_orders
from trainer.model.model import EffectInstance, Model, absent, instance_with
from trainer.model.parameters import describe, json_values
from trainer.prediction.stages import Sensor

KNOWN = catalogue()
LEAK = ("leak_real", "leak_imaginary")


def batches_of(captures: CaptureSet) -> list[Batch]:
    return load(captures, captures.captures)


def fitted(captures: CaptureSet, start: EffectInstance) -> EffectInstance:
    model = Model(captures.bench).having(start)
    return fit(model, [start.effect.name], batches_of(captures)).model.present[0]


ZERO_ORDER = {"leak_real": 0.06, "leak_imaginary": -0.03, "fill_factor": 0.95}


@pytest.mark.parametrize(
    ("name", "truth", "table_pixels"),
    [
        ("distance", {"offset": 0.08}, jacobian.TABLE_PIXELS),
        ("zero_order", ZERO_ORDER, jacobian.TABLE_PIXELS),
        ("zero_order", ZERO_ORDER, 600),
        (
            "misregistration",
            {"shift_y": 0.2, "shift_x": -0.1, "rotation": 0.8, "magnification": 0.05},
            jacobian.TABLE_PIXELS,
        ),
        ("ghost", {"amplitude": 0.05, "shift_y": -3.3, "shift_x": 6.4}, jacobian.TABLE_PIXELS),
    ],
)
def test_true_values_lie_within_the_stated_errors(
    name: str, truth: dict[str, float], table_pixels: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jacobian, "TABLE_PIXELS", table_pixels)
    effect = KNOWN[name]
    scores = []
    for seed in range(4):
        captures = captures_with(tmp_path / str(seed), effect, truth, patterns=3, seed=seed)
        found = fitted(
            captures, instance_with(effect, captures.bench, {k: 0.9 * v for k, v in truth.items()})
        )
        assert found.errors is not None
        for key, value in truth.items():
            true = float(np.asarray(value))
            scores.append(float((found.values[key] - true).reshape(-1)[0] / found.errors[key].reshape(-1)[0]))
    # The mean square of n normal scores lies in this range but for one case in some thousands.
    assert max(map(abs, scores)) < 4
    assert 0.15 < np.mean(np.square(scores)) < 3.5


def test_tables_of_large_pictures_have_every_column_and_the_sums_of_all_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    effect = KNOWN["vignetting"]
    captures = captures_with(
        tmp_path, effect, {"log_gain": [0.2, -0.1, 0.1, 0.05, -0.1]}, patterns=3, order=2
    )
    batches = batches_of(captures)
    height, width = batches[0].mask.shape[-2:]
    start = Model(captures.bench).having(absent(effect, captures.bench))
    whole = fit(start, ["vignetting"], batches)
    monkeypatch.setattr(jacobian, "TABLE_PIXELS", height * width // 4 + 1)
    every = next(n for n in range(4, 99) if math.gcd(n, width) == 1)
    place = torch.arange(width).expand(height, width)
    one = batches[0].only([0])
    columns = jacobian.weighted(replace(one, mask=torch.ones_like(one.mask)), place[None] + 1.0)
    assert len(columns) == math.ceil(height * width / every)
    seen = torch.bincount((columns / math.sqrt(every)).round().long() - 1, minlength=width)
    assert seen.min() >= height // every
    few = fit(start, ["vignetting"], batches)
    errors = [np.sqrt(np.diag(f.covariance)) for f in (whole, few)]
    assert errors[1] == pytest.approx(math.sqrt(every) * errors[0], rel=0.2)
    away = few.model.present[0].values["log_gain"] - whole.model.present[0].values["log_gain"]
    assert np.abs(away / errors[1][:-1]).max() < 4
    assert few.errors.excess == pytest.approx(whole.errors.excess, abs=2e-5)


def test_an_order_is_raised_as_far_as_the_captures_ask_and_no_farther(tmp_path: Path) -> None:
    effect = KNOWN["vignetting"]
    terms = np.zeros(legendre_count(4))
    terms[[0, 4, -1]] = 0.2, -0.15, 0.1
    captures = captures_with(tmp_path, effect, {"log_gain": terms}, patterns=3, order=4)
    batches = batches_of(captures)
    lowest = fit(Model(captures.bench).having(absent(effect, captures.bench)), ["vignetting"], batches)
    assert lowest.model.present[0].order == 2
    best = raise_orders(lowest, ["vignetting"], batches, least_for_order)
    assert best.model.present[0].order == 4
    assert best.model.present[0].values["log_gain"] == pytest.approx(terms, abs=3e-3)
    # Where the camera's noise is all but a tenth of what a complete model may leave, captures ask for nothing.
    errors = lowest.errors
    share = 3e-5 * float(errors.variance.sum() / errors.squared.sum())
    noisy = replace(lowest, errors=replace(errors, noise=(1 - share) * errors.squared))
    assert noisy.errors.excess == pytest.approx(3e-5)
    assert raise_orders(noisy, ["vignetting"], batches, least_for_order) is noisy


def test_orders_of_two_effects_are_raised_together(tmp_path: Path) -> None:
    effect = KNOWN["vignetting"]
    terms = np.zeros(legendre_count(4))
    terms[[0, 4, -1]] = 0.2, -0.15, 0.1
    captures = captures_with(tmp_path, effect, {"log_gain": terms}, patterns=3, order=4)
    batches = batches_of(captures)
    model = Model(captures.bench)
    for name in ("vignetting", "stray_light"):
        model = model.having(absent(KNOWN[name], captures.bench))
    best = raise_orders(fit(model, model.names, batches), model.names, batches, least_for_order).model
    assert best.instance("vignetting").order == 4
    assert best.instance("stray_light").order == 1  # nothing asks for more


def test_derivatives_say_of_a_step_what_it_did_and_of_other_directions_what_they_said() -> None:
    rng = np.random.default_rng(3)
    table = torch.as_tensor(rng.normal(size=(4, 500)), dtype=torch.float64)
    table[3] = 0  # of another colour
    before, step = table.clone(), rng.normal(size=4)
    taken = torch.as_tensor(step)
    bent = torch.as_tensor(rng.normal(size=500))
    change = taken @ table + 0.5 * bent
    share = follow([table], [change], step)
    assert share == pytest.approx(float(0.25 * bent @ bent / (change @ change)))
    torch.testing.assert_close(taken @ table, change)
    assert not table[3].any()
    # A direction that the step has no part in, by what each number does, is as it was.
    across = torch.tensor(
        [float(before[1] @ before[1]) * step[1], -float(before[0] @ before[0]) * step[0], 0, 0]
    )
    torch.testing.assert_close(across.double() @ table, across.double() @ before)
    assert follow([table], [taken @ table], step) == pytest.approx(0, abs=1e-12)


def test_a_rough_fit_ends_where_a_fine_one_does_with_fewer_derivatives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is left beside the leak lets no step remove half of the excess.
    narrow = 'kind = "illumination"\nwaist_x_share = 0.8\nwaist_y_share = 0.9'
    acquire_from(str(bench_file(tmp_path, narrow, 'kind = "zero_order"')), tmp_path / "captures", patterns=3)
    captures = read_captures(tmp_path / "captures")
    batches = batches_of(captures)
    start = Model(captures.bench).having(absent(KNOWN["zero_order"], captures.bench, 0))
    tables = 0

    def counted(*given: Any) -> list[Tensor]:
        nonlocal tables
        tables += 1
        return jacobian.slopes_of(*given)

    monkeypatch.setattr(gauss_newton, "slopes_of", counted)
    fine = fit(start, ["zero_order"], batches, hold=1e-6)
    needed, tables = tables, 0
    rough = fit(start, ["zero_order"], batches, tolerance=ROUGH, hold=1e-6)
    assert tables < needed
    assert fine.errors.excess > 0.01
    assert rough.errors.excess < (1 + ROUGH) * fine.errors.excess


def test_derivatives_of_further_numbers_are_those_that_their_fit_would_compute(tmp_path: Path) -> None:
    effect = KNOWN["vignetting"]
    terms = np.zeros(legendre_count(4))
    terms[[0, 4, -1]] = 0.2, -0.15, 0.1
    captures = captures_with(tmp_path, effect, {"log_gain": terms}, patterns=3, order=4)
    (batch,) = batches_of(captures)
    model = Model(captures.bench)
    for name in ("vignetting", "zero_order", "stray_light"):
        model = model.having(absent(KNOWN[name], captures.bench))
    fixed = (("zero_order", "leak_wavefront"),)
    rising = ("vignetting", "stray_light")
    first = batch.only([0])
    model = fit(model, model.names, [first], fixed=fixed).model
    found = with_numbers_that_pay(model, model.names, rising, [first], 1e-4, fixed)
    assert found is not None
    raised, slopes = found
    assert raised.instance("vignetting").order > model.instance("vignetting").order
    assert raised.instance("stray_light").order == model.instance("stray_light").order
    assert slopes is not None
    keys = tuple(key for key in jacobian.keys_of(raised, raised.names) if key[:2] not in fixed)
    predictor = Predictor(raised, first)
    with torch.no_grad():
        expected = jacobian.slopes_of(raised, keys, [batch.channel], [predictor], [predictor.trace(raised)])
    torch.testing.assert_close(slopes, expected)
    # Of several captures, a single one is looked at.
    several = with_numbers_that_pay(model, model.names, rising, [batch], 1e-4, fixed)
    assert several is not None and several[1] is None


def test_dead_space_and_a_flat_first_surface_are_found_beside_a_bent_panel(tmp_path: Path) -> None:
    bent = 'kind = "panel_wavefront"\npeak_to_valley_nm = 700'
    acquire_from(str(bench_file(tmp_path, bent, 'kind = "zero_order"')), tmp_path / "captures")
    captures = read_captures(tmp_path / "captures")
    batches = batches_of(captures)
    model = Model(captures.bench)
    for name, order in (("panel_wavefront", 6), ("zero_order", 0)):
        model = model.having(absent(KNOWN[name], captures.bench, order))
    one = fit(model, model.names, batches)
    both = raise_orders(one, model.names, batches, least_for_order)
    present = both.model.instance("zero_order")
    assert present.order > 0
    flat, leak = (np.hypot(*v) for v in (present.values["flat_leak"], [present.values[k] for k in LEAK]))
    # What the bench has: 0.15 from its surface, and 0.7 of the tenth of the area that is dead.
    assert flat == pytest.approx(0.15, rel=0.2) and leak == pytest.approx(0.07, rel=0.3)
    assert both.errors.excess < 0.1 * one.errors.excess


def test_a_value_stays_in_its_physical_range(tmp_path: Path) -> None:
    effect = KNOWN["zero_order"]
    captures = captures_with(tmp_path, effect, {"fill_factor": 1.0}, patterns=3)
    found = fitted(captures, instance_with(effect, captures.bench, {"fill_factor": 0.99}))
    assert 0.99 < float(found.values["fill_factor"]) <= 1.0


def test_a_value_that_changes_nothing_has_no_error_instead_of_none_at_all(tmp_path: Path) -> None:
    """Where a ghost that is not there would lie: an error of zero would say that it is known exactly."""
    effect = KNOWN["ghost"]
    captures = captures_with(tmp_path, effect, {"amplitude": 0.0}, patterns=3)
    model = Model(captures.bench).having(instance_with(effect, captures.bench, {"shift_y": 3.0}))
    found = fit(model, ["ghost"], batches_of(captures), fixed={("ghost", "amplitude")}).model.present[0]
    assert found.errors is not None
    assert np.isnan(found.errors["shift_y"]) and np.isnan(found.errors["shift_x"])
    said = json_values(found, captures.bench)
    assert plain(said)["shift_y_px"]["error"] is None
    assert "±" not in describe(found, captures.bench)


def test_a_value_that_changes_nothing_holds_no_other_up(tmp_path: Path) -> None:
    # The drift of a laser's power is measured: its spread matters only where it is zero. A step by its derivative,
    # which is rounding alone, would go anywhere, and no other number would move where that is zero.
    moved, drift = 'kind = "distance"\noffset_mm = 0.1', 'kind = "laser_drift"'
    acquire_from(str(bench_file(tmp_path, moved, drift)), tmp_path / "captures", patterns=3)
    captures = read_captures(tmp_path / "captures")
    drifting = Model(captures.bench).having(
        instance_with(KNOWN["laser_drift"], captures.bench, {"spread": 0.5})
    )
    for offset in (0.06, 0.08, 0.12, 0.14):
        start = instance_with(KNOWN["distance"], captures.bench, {"offset": offset})
        found = fit(drifting.having(start), ["distance", "laser_drift"], batches_of(captures)).model
        assert float(found.instance("distance").values["offset"]) == pytest.approx(0.1, abs=0.005)


def test_a_fit_that_will_not_come_near_is_given_up_and_no_other(tmp_path: Path) -> None:
    effect = KNOWN["ghost"]
    captures = captures_with(tmp_path, effect, {"amplitude": 0.05, "shift_y": -3.3, "shift_x": 6.4}, 3)
    right = instance_with(effect, captures.bench, {"amplitude": 0.02, "shift_y": -3.0, "shift_x": 6.0})
    wrong = absent(KNOWN["illumination"], captures.bench)
    batches = batches_of(captures)
    for start, is_right in ((right, True), (wrong, False)):
        model, names = Model(captures.bench).having(start), [start.effect.name]
        patient, hasty = fit(model, names, batches), fit(model, names, batches, enough=1e-4)
        assert (patient.errors.excess < 1e-4) == is_right
        if is_right:
            assert hasty.errors.excess == patient.errors.excess
        else:
            assert not hasty.settled
            assert hasty.errors.excess > 0.9 * patient.errors.excess
            assert plain(hasty.model.present[0].values) == plain(start.values)


def test_a_fit_that_is_too_slow_for_what_is_enough_is_given_up_on_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_too_slow(0.01, 4, 0.5, 0.41) and not is_too_slow(0.01, 4, 0.5, 0.43)
    assert is_too_slow(-0.01, 4, 0.5, 0.49)  # it went the wrong way
    assert not is_too_slow(0.0, 0, 0.5, math.inf)
    captures = captures_with(tmp_path, KNOWN["ghost"], {"amplitude": 0.3, "shift_x": 6.4}, 3)
    model = Model(captures.bench).having(absent(KNOWN["panel_wavefront"], captures.bench, 4))
    batches, steps = batches_of(captures), []
    slopes_of = gauss_newton.slopes_of
    monkeypatch.setattr(gauss_newton, "slopes_of", lambda *given: (steps.append(given), slopes_of(*given))[1])
    patient = fit(model, model.names, batches)
    longest = len(steps)
    assert patient.errors.excess > 0.01
    easy = fit(model, model.names, batches, enough=1.01 * patient.errors.excess)
    assert easy.errors.excess == patient.errors.excess
    steps.clear()
    given_up = fit(model, model.names, batches, enough=0.9 * patient.errors.excess)
    assert not given_up.settled and len(steps) < longest


LAMP_COUNTS = 60


@effect(
    stage="sensor",
    acts_on="camera",
    parameters=[Parameter("cube_root", "1", scale=0.05, absent=0.2, low=0, high=10)],
)
def lamp(sensor: Sensor, cube_root: torch.Tensor) -> Sensor:
    """A lamp lights the left half."""
    return sensor.brightened(LAMP_COUNTS * cube_root**3 * (sensor.x < 0))


def test_a_step_that_had_to_be_shortened_is_not_taken_for_the_end(tmp_path: Path) -> None:
    """From 0.2 a whole step leads past 8, where the lamp is 600 times as bright; a short one removes little."""
    captures = make_set(tmp_path / "captures", patterns=6)
    for row in captures.captures:
        counts = np.asarray(Image.open(row.image)).astype(int)
        counts[:, : counts.shape[1] // 2] += LAMP_COUNTS
        Image.fromarray(counts.astype(np.uint16)).save(row.image)
    captures = read_captures(captures.folder)
    model = Model(captures.bench).having(absent(lamp, captures.bench))
    found = fit(model, ["lamp"], batches_of(captures), tolerance=0.2).model.instance("lamp")
    assert float(found.values["cube_root"]) == pytest.approx(1, abs=0.01)


def test_a_step_within_ranges_is_the_best_one_there() -> None:
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(20):
        table = rng.normal(size=(40, 6)) @ np.diag([1, 10, 0.1, 1, 1, 5])
        table[:, 1] += 3 * table[:, 0]  # two that do each other's work
        normal, gradient = table.T @ table, table.T @ rng.normal(size=40) * 3
        reach = -rng.uniform(0, 0.3, 6), rng.uniform(0, 0.3, 6)
        step = jacobian.step_within(normal, gradient, 0.0, reach)
        assert np.all((step >= reach[0] - 1e-12) & (step <= reach[1] + 1e-12))
        # Karush, Kuhn and Tucker: at an end, what is left pulls outwards; inside, nothing pulls.
        pull = (gradient - normal @ step) / np.sqrt(np.diag(normal))
        inside = (step > reach[0] + 1e-12) & (step < reach[1] - 1e-12)
        assert np.abs(pull[inside]).max(initial=0) < 1e-5 * np.abs(gradient).max()
        assert np.all(pull[step >= reach[1] - 1e-12] >= 0) and np.all(pull[step <= reach[0] + 1e-12] <= 0)
        held += int((~inside).sum())
    assert held > 20
    free = np.full(6, np.inf)
    unbounded = jacobian.step_within(normal, gradient, 0.1, (-free, free))
    np.testing.assert_array_equal(unbounded, jacobian.damped_step(normal, gradient, 0.1))


def test_where_a_number_is_at_its_end_the_others_do_what_is_best_without_it(tmp_path: Path) -> None:
    @effect(stage="sensor", acts_on="camera", parameters=[Parameter("share", "1", scale=0.01, low=0, high=1)])
    def fog(sensor: Sensor, share: torch.Tensor) -> Sensor:
        """A share of full scale is added everywhere."""
        return sensor.brightened(share * sensor.full_scale)

    @effect(
        stage="sensor", acts_on="camera", parameters=[Parameter("share", "1", scale=0.01, low=0, high=0.02)]
    )
    def haze(sensor: Sensor, share: torch.Tensor) -> Sensor:
        """The same, of little at most."""
        return sensor.brightened(share * sensor.full_scale)

    @effect(
        stage="sensor", acts_on="camera", parameters=[Parameter("share", "1", scale=0.01, low=-1, high=1)]
    )
    def glow(sensor: Sensor, share: torch.Tensor) -> Sensor:
        """More is added from left to right."""
        return sensor.brightened(share * sensor.full_scale * (1.5 + sensor.x))

    captures = captures_with(tmp_path, fog, {"share": 0.06}, patterns=3)
    batches = batches_of(captures)
    bench = captures.bench
    both = Model(bench).having(absent(haze, bench)).having(absent(glow, bench))
    together = fit(both, ["haze", "glow"], batches)
    at_end = both.having(instance_with(haze, bench, {"share": 0.02}))
    alone = fit(at_end, ["glow"], batches)
    assert together.model.instance("haze").values["share"] == pytest.approx(0.02, abs=1e-9)
    found, best = (f.model.instance("glow").values["share"] for f in (together, alone))
    assert found == pytest.approx(best, rel=1e-3)
    assert found > 0.01
    assert together.errors.excess == pytest.approx(alone.errors.excess, rel=1e-3)
