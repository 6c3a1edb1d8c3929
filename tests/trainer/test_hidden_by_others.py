"""A missing effect whose work present ones have taken up: it shows only where it is fitted together with them."""

from __future__ import annotations

import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.diagnosis import diagnose
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import fit_from, settled
from trainer.model.model import Model, absent

HIDDEN = (
    'kind = "stray_light"\nglow_counts = 80.2',
    'kind = "phase_ripple"',
    'kind = "phase_response"\ngain = 1.0575\ns_curvature = -0.1606\nlopsidedness = -0.0209',
    'kind = "sensor_response"\nknee_share = 0.4721',
)
# In the order in which the best one at each step is added: vignetting stands for the stray light.
ADDED = ("sensor_response", "phase_response", "vignetting", "phase_ripple")
CANDIDATES = ("stray_light", "polarisation_leak", "source_lines", "laser_drift", "ghost", "vibration")


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    folder = tmp_path_factory.mktemp("hidden")
    acquire_from(
        str(bench_file(folder, *HIDDEN, width=128, height=96, distance_mm=12)),
        folder / "captures",
        patterns=8,
    )
    return read_captures(folder / "captures")


def test_stray_light_that_vignetting_and_a_bent_response_hide_is_found(captures: CaptureSet) -> None:
    known, roles = catalogue(), capture_roles(captures)
    batches = load(captures, roles.fitted)
    model = with_gains(captures, Model(captures.bench), roles.fitted)
    for name in ADDED:
        model = settled(fit_from(model, absent(known[name], captures.bench), batches).model, batches).model
    left = evaluate_captures(captures, roles.held_out, model).excess
    assert left > 0.003
    with open_pool(1) as pool:
        some = {name: known[name] for name in (*ADDED, *CANDIDATES)}
        found = diagnose(captures, model, some, pool, thorough=False)
    assert found.verdict == "missing" and found.best is not None
    assert found.best.effect.name == "stray_light"
    assert found.best.held_out.excess < 0.1 * left
