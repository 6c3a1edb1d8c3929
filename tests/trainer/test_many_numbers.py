"""Effects of many numbers: fitted through the adjoint as a table of derivatives would have it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.screen import screen_batches
from trainer.effects import Panel, Parameter, Sensor, discs, effect, testing
from trainer.fitting import gauss_newton, jacobian, many_numbers
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.jacobian import keys_of, slopes_of, weighted_residuals
from trainer.fitting.many_numbers import ManySlopes, has_many
from trainer.fitting.predictor import Predictor, evaluate_captures
from trainer.model.model import Model, absent

COLUMNS = 96
TRUE = 0.1 * np.random.default_rng(2).standard_normal(COLUMNS)


@effect(
    stage="panel",
    acts_on="display",
    parameters=[
        Parameter("each", "1", scale=0.02, low=-0.9, high=3, count=COLUMNS),
        Parameter("tilt", "rad", scale=0.05, low=-9, high=9),
    ],
)
def own_columns(panel: Panel, each: Tensor, tilt: Tensor) -> Panel:
    """Each column has its own amplitude, and the panel is tilted."""
    turned = torch.polar((1 + each).expand(panel.y.shape), tilt * panel.y)
    return panel.multiplied(turned)


@effect(stage="sensor", acts_on="camera", parameters=[Parameter("fall", "1", scale=0.05, low=-1, high=1)])
def own_fall(sensor: Sensor, fall: Tensor) -> Sensor:
    """The picture is darker on one side."""
    return sensor.multiplied(1 + fall * sensor.x)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    folder = tmp_path_factory.mktemp("columns") / "captures"
    return testing.captures_with(folder, own_columns, {"each": TRUE, "tilt": 0.6})


def prepared(captures: CaptureSet) -> tuple[Model, list]:
    roles = capture_roles(captures)
    model = with_gains(captures, Model(captures.bench), roles.fitted)
    return model, load(captures, roles.fitted)


@pytest.mark.parametrize("table_pixels", [jacobian.TABLE_PIXELS, 1000])
def test_both_products_are_those_of_the_table(
    captures: CaptureSet, monkeypatch: pytest.MonkeyPatch, table_pixels: int
) -> None:
    monkeypatch.setattr(jacobian, "TABLE_PIXELS", table_pixels)
    bare, batches = prepared(captures)
    model = bare.having(absent(own_columns, captures.bench)).having(absent(own_fall, captures.bench))
    predictors = [Predictor(model, b) for b in batches]
    with torch.no_grad():
        points = [p.trace(model) for p in predictors]
        channels = [b.channel for b in batches]
        others = slopes_of(model, keys_of(model, ["own_fall"]), channels, predictors, points)
        table = slopes_of(model, keys_of(model, ["own_columns"]), channels, predictors, points)
        residuals, _ = weighted_residuals(model, predictors, points)
    slopes = ManySlopes(model, ["own_columns"], predictors, points, others)
    direction = np.random.default_rng(0).standard_normal(slopes.scales.size)
    there = [torch.as_tensor(direction * slopes.scales, dtype=t.dtype) @ t[:-1] for t in table]
    for mine, wanted in zip(slopes.along_with_others(direction), there, strict=True):
        assert torch.linalg.vector_norm(mine - wanted) < 0.02 * torch.linalg.vector_norm(wanted)
    back = sum((t[:-1] @ r).double().numpy() for t, r in zip(table, slopes.alone(residuals), strict=True))
    assert np.allclose(
        slopes.across(residuals), back * slopes.scales, atol=0.02 * np.abs(back * slopes.scales).max()
    )


def test_many_numbers_are_fitted_as_by_the_table(
    captures: CaptureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, batches = prepared(captures)
    start = model.having(absent(own_columns, captures.bench)).having(absent(own_fall, captures.bench))
    by_table = fit(start, start.names, batches)
    for module in (many_numbers, gauss_newton):
        monkeypatch.setattr(module, "has_many", lambda present: present.effect is own_columns)
    by_products = fit(start, start.names, batches)
    held = capture_roles(captures).held_out
    assert abs(evaluate_captures(captures, held, by_products.model).excess) < 3e-4
    found, wanted = (f.model.instance("own_columns") for f in (by_products, by_table))
    assert found.errors is not None and wanted.errors is not None
    # The gain takes up a common factor.
    ratio = (1 + found.values["each"]) / (1 + wanted.values["each"])
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.01
    true = (1 + found.values["each"]) / (1 + TRUE)
    errors = found.errors["each"]
    assert np.std(true / true.mean() - 1) < 2.5 * np.mean(errors)
    assert np.mean(errors) < 2 * np.median(wanted.errors["each"])
    assert found.values["tilt"] == pytest.approx(0.6, abs=0.02)
    assert len(by_products.keys) + 1 == len(by_products.covariance)


def test_the_screen_expects_what_the_fit_of_many_numbers_removes(
    captures: CaptureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, batches = prepared(captures)
    assert not has_many(absent(own_columns, captures.bench))
    with torch.no_grad():
        (by_table,) = screen_batches(batches, model, (own_columns,))
        monkeypatch.setattr("trainer.diagnosis.screen.has_many", lambda present: True)
        (by_products,) = screen_batches(batches, model, (own_columns,))
    assert by_products.removed_excess == pytest.approx(by_table.removed_excess, rel=0.05)


def test_discs_cover_their_area_and_have_derivatives() -> None:
    y, x = torch.meshgrid(torch.arange(-20.0, 21), torch.arange(-30.0, 31), indexing="ij")
    row, column, radius = (
        torch.tensor(v, requires_grad=True) for v in ([-3.2, 9.7], [4.4, -11.3], [5.3, 2.6])
    )
    inside = torch.tensor(0.25, requires_grad=True)
    whole = discs(y, x, row, column, radius, inside)
    covered = float((1 - whole).detach().sum()) / 0.75
    assert covered == pytest.approx(np.pi * (5.3**2 + 2.6**2), rel=0.02)
    weights = torch.as_tensor(np.random.default_rng(0).standard_normal(whole.shape), dtype=torch.float32)
    slopes = torch.autograd.grad((weights * whole).sum(), [row, column, radius, inside])
    assert all(bool((s != 0).all()) for s in slopes)
    # One beyond the border changes nothing; places and sizes may differ by less than a pixel.
    away = discs(y, x, torch.tensor([90.0]), torch.tensor([0.0]), torch.tensor([3.0]), torch.tensor(0.0))
    assert bool((away == 1).all())
    half = discs(y, x, torch.tensor([0.0]), torch.tensor([0.5]), torch.tensor([3.0]), torch.tensor(0.0))
    assert float(half[20, 33]) == pytest.approx(float(half[20, 28]), abs=1e-5)
