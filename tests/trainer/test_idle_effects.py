"""Effects whose work the others do are left out, all at once; what is needed stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import Batch, load
from trainer.captures.capture_set import read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.idle_effects import without_idle
from trainer.fitting.predictor import excess_on
from trainer.fitting.refit import settled
from trainer.model.model import Model, absent

LEAST = Thresholds().least(1.0)


def taken(folder: Path, *hidden: str) -> tuple[Model, list[Batch]]:
    """The ideal model, and what it is fitted to, of a bench with these defects."""
    acquire_from(str(bench_file(folder, *hidden)), folder / "captures", patterns=6)
    captures = read_captures(folder / "captures")
    roles = capture_roles(captures)
    return with_gains(captures, Model(captures.bench), roles.fitted), load(captures, roles.fitted)


def fitted(model: Model, names: tuple[str, ...], batches: list[Batch]) -> Model:
    for name in names:
        model = model.having(absent(catalogue()[name], model.bench))
    return fit(model, names, batches).model


@pytest.mark.parametrize("bent", [False, True], ids=["straight response", "bent response"])
def test_what_the_fit_did_not_use_goes_at_once(bent: bool, tmp_path: Path) -> None:
    hidden = ('kind = "distance"', 'kind = "laser_drift"', *(['kind = "sensor_response"'] if bent else ()))
    ideal, batches = taken(tmp_path, *hidden)
    more = ("vignetting", "crosstalk", "sensor_blur", "zero_order", "sensor_response", "laser_drift")
    model = settled(fitted(ideal, ("distance", *more), batches), batches).model
    found = without_idle(model, batches, LEAST)
    assert set(found.names) == {"distance", "laser_drift", *(["sensor_response"] if bent else ())}
    rest = fit(found, found.names, batches).model
    assert excess_on(rest, batches) < excess_on(model, batches) + LEAST


def test_of_two_that_do_the_same_one_stays(tmp_path: Path) -> None:
    """A camera that is moved, and a tilt of the wavefront: each can do all, and one must."""
    ideal, batches = taken(tmp_path, 'kind = "misregistration"')
    bent = absent(catalogue()["panel_wavefront"], ideal.bench)
    tilt = np.zeros_like(bent.values["wavefront"])
    tilt[0] = 0.3
    tilted = ideal.having(replace(bent, values={**bent.values, "wavefront": tilt}))
    moved = fitted(tilted, ("misregistration",), batches)
    both = fit(moved.having(tilted.instance("panel_wavefront")), ("misregistration",), batches).model
    assert excess_on(both.without("misregistration"), batches) > 20 * LEAST
    assert excess_on(both.without("panel_wavefront"), batches) > 20 * LEAST
    alone = without_idle(both, batches, LEAST)
    assert len(alone.names) == 1
    (gone,) = set(both.names) - set(alone.names)
    # the other one has taken over already
    assert excess_on(alone, batches) < 0.1 * excess_on(both.without(gone), batches)


def test_an_effect_that_is_measured_stays(tmp_path: Path) -> None:
    """Whether it is needed shows from capture to capture, not in one."""
    ideal, batches = taken(tmp_path)
    model = fitted(ideal, ("distance", "fixed_pattern"), batches)
    assert without_idle(model, batches, LEAST).names == ("fixed_pattern",)
