"""An effect that only looked right is exchanged for the right one, and the right one is not exchanged."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.addition import all_refitted
from trainer.diagnosis.exchange import exchanged, one_for_two, preferred
from trainer.diagnosis.screen import screen_batches
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import fit_from
from trainer.model.model import Model, absent, instance_with


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    folder = tmp_path_factory.mktemp("exchange")
    acquire_from(str(bench_file(folder, 'kind = "phase_response"')), folder / "captures", patterns=6)
    return read_captures(folder / "captures")


@pytest.mark.parametrize(
    ("present", "rival", "expected"),
    [
        ("zero_order", "phase_response", ("zero_order", "phase_response")),
        ("phase_response", "zero_order", None),
    ],
)
def test_held_out_captures_decide(
    present: str, rival: str, expected: tuple[str, str] | None, captures: CaptureSet
) -> None:
    roles = capture_roles(captures)
    batches = load(captures, roles.fitted)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    model, other = (
        fit(ideal.having(absent(catalogue()[name], captures.bench)), [name], batches).model
        for name in (present, rival)
    )
    errors = evaluate_captures(captures, roles.held_out, model)
    with open_pool(1) as pool:
        found = exchanged(roles, model, errors, {present: {rival: other.instance(rival)}}, pool)
        assert exchanged(roles, model, errors, {rival: {present: model.instance(present)}}, pool) is None
    assert (None if found is None else found[:2]) == expected
    if found is not None:
        assert found[2].names == (rival,) and found[3].excess < 0.5 * errors.excess


@pytest.mark.parametrize(
    ("hidden", "stands"),
    [
        (("polarisation_leak",), True),
        (("amplitude_modulation", "phase_response"), False),
    ],
)
def test_a_rival_stands_for_two_effects_where_it_does_as_well(
    hidden: tuple[str, ...], stands: bool, tmp_path: Path
) -> None:
    """A leak has a phase and an amplitude curve; of these two a leak has only some."""
    bench = bench_file(tmp_path, *(f'kind = "{name}"' for name in hidden))
    acquire_from(str(bench), tmp_path / "captures", patterns=6)
    captures = read_captures(tmp_path / "captures")
    roles = capture_roles(captures)
    batches = load(captures, roles.fitted)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)

    def fitted(*effects: tuple[str, int]) -> Model:
        model = ideal
        for name, order in effects:
            model = model.having(absent(catalogue()[name], captures.bench, order))
        return fit(model, model.names, batches, 30).model

    model = fitted(("amplitude_modulation", 6), ("phase_response", 6))
    errors = evaluate_captures(captures, roles.held_out, model)
    assert errors.excess < 5e-4
    leak = fitted(("polarisation_leak", 0)).instance("polarisation_leak")
    with open_pool(1) as pool:
        found = one_for_two(
            roles, model, errors, {"amplitude_modulation": {leak.effect.name: leak}}, Thresholds(), 1.0, pool
        )
    assert (None if found is None else found[:3]) == (
        ("polarisation_leak", "amplitude_modulation", "phase_response") if stands else None
    )
    if found is not None:
        assert found[3].names == ("polarisation_leak",) and found[4].excess < 5e-4


@pytest.mark.parametrize(
    ("hidden", "rival"),
    [("distance", "source_lines"), ("source_lines", "distance"), ("spatial_coherence", "sensor_blur")],
)
def test_captures_that_tell_in_the_end_decide_between_effects_that_were_alike(
    hidden: str, rival: str, tmp_path: Path
) -> None:
    """Two lines may both lie aside, and then are a distance; a blur of the camera is much like a source's extent."""
    acquire_from(str(bench_file(tmp_path, f'kind = "{hidden}"')), tmp_path / "captures", patterns=6)
    captures = read_captures(tmp_path / "captures")
    roles = capture_roles(captures)
    batches = load(captures, roles.fitted)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    models = {}
    for name in (hidden, rival):
        start = screen_batches(batches, ideal, (catalogue()[name],))[0].start
        models[name] = fit_from(ideal, start, batches).model
    exchanges = {}
    with open_pool(1) as pool:
        for present, other in ((hidden, rival), (rival, hidden)):
            errors = evaluate_captures(captures, roles.held_out, models[present])
            alike = {present: {other: models[other].instance(other)}}
            found = preferred(roles, models[present], errors, alike, Thresholds(), 1.0, pool)
            exchanges[present] = None if found is None else found[:2]
    assert exchanges == {hidden: None, rival: (rival, hidden)}


def test_a_refit_begins_where_least_is_left(tmp_path: Path) -> None:
    """Speckle of a plane that is far off says nothing of where the right one is."""
    hidden = 'kind = "distance"\noffset_mm = 0.5'
    acquire_from(str(bench_file(tmp_path, hidden)), tmp_path / "captures", patterns=4)
    captures = read_captures(tmp_path / "captures")
    roles = capture_roles(captures)
    ideal = with_gains(captures, Model(captures.bench), roles.fitted)
    near, far = (
        ideal.having(instance_with(catalogue()["distance"], captures.bench, {"offset": offset}))
        for offset in (0.45, -8.0)
    )
    ids = ids_of(captures.captures)
    right, wrong = (all_refitted(roles.folder, ids, one)[1].excess for one in (near, far))
    assert right < 1e-3 < 0.1 * wrong
    for starts in ((near, far), (far, near)):
        assert all_refitted(roles.folder, ids, *starts)[1].excess == right
