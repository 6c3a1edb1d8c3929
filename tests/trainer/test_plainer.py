"""At the end, a plainer effect is looked for in the place of one that has more numbers than it needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import CaptureRoles, capture_roles
from trainer.diagnosis.exchange import preferred
from trainer.diagnosis.plainer import plainer_rivals
from trainer.diagnosis.screen import screen_batches
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import fit_from
from trainer.model.model import Model


def captured(folder: Path, hidden: str) -> CaptureSet:
    acquire_from(str(bench_file(folder, hidden)), folder / "captures", patterns=6)
    return read_captures(folder / "captures")


def fitted(captures: CaptureSet, roles: CaptureRoles, name: str) -> Model:
    """A model with one effect, whatever the captures hide."""
    batches = load(captures, roles.fitted)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    return fit_from(
        ideal, screen_batches(batches, ideal, (catalogue()[name],))[0].start, batches, iterations=20
    ).model


@pytest.mark.parametrize(
    ("hidden", "found", "plainer", "exchanged"),
    [
        ('kind = "distance"', "source_lines", "distance", True),
        ('kind = "amplitude_modulation"\nfall = 0.22', "polarisation_leak", "amplitude_modulation", True),
        ('kind = "source_lines"\nshare = 0.4', "source_lines", "distance", False),
        ('kind = "polarisation_leak"', "polarisation_leak", "amplitude_modulation", False),
    ],
)
def test_captures_say_whether_a_plainer_effect_does_as_well(
    hidden: str, found: str, plainer: str, exchanged: bool, tmp_path: Path
) -> None:
    captures = captured(tmp_path, hidden)
    roles = capture_roles(captures)
    model = fitted(captures, roles, found)
    errors = evaluate_captures(captures, roles.held_out, model)
    with open_pool(1) as pool:
        rivals = plainer_rivals(roles, model, [found], catalogue(), pool)
        better = preferred(roles, model, errors, rivals, Thresholds(), 1.0, pool)
    assert (plainer in rivals[found]) or not exchanged
    assert (None if better is None else better[:2]) == ((found, plainer) if exchanged else None)
    if better is not None:
        assert better[3].excess < errors.excess + Thresholds().excess


def test_nothing_is_plainer_than_an_effect_of_one_number(tmp_path: Path) -> None:
    captures = captured(tmp_path, 'kind = "distance"')
    roles = capture_roles(captures)
    model = fitted(captures, roles, "distance")
    with open_pool(1) as pool:
        assert plainer_rivals(roles, model, model.names, catalogue(), pool) == {}
