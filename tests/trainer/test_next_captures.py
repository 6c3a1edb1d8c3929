"""The captures that say most: information that is what fits then find, and rivals told apart."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import InputError
from tests.trainer.extended_source import FEW, captured, extended_source
from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.further_captures import copy_captures, new_ids
from trainer.captures.held_out import holds_out
from trainer.captures.patterns import PATTERN_KINDS, pattern_of_kind
from trainer.captures.possible_captures import PossibleCapture, possible_captures
from trainer.diagnosis.capture_choice import next_captures
from trainer.diagnosis.diagnosis import diagnose
from trainer.diagnosis.doubts import Doubts, Rival, doubts_of, fit_rows
from trainer.diagnosis.expected_information import (
    ExpectedInformation,
    covariance,
    information_of_captures,
    information_of_possible,
    prior,
)
from trainer.diagnosis.explanation import explain
from trainer.effects.effect_catalogue import catalogue
from trainer.effects.testing import captures_with, small_bench
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import open_pool
from trainer.model.model import Model, absent, instance_with

KNOWN = catalogue()


@pytest.fixture(autouse=True)
def _one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.fitting.pool.cores", lambda: 1)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    return captured(extended_source(tmp_path_factory.mktemp("bench")))


@pytest.fixture(scope="module")
def doubts(captures: CaptureSet) -> Doubts:
    """What the set leaves in doubt among four candidates."""
    with open_pool(1) as pool:
        return doubts_of(captures, Model(captures.bench), {n: KNOWN[n] for n in FEW}, pool)


@pytest.fixture(scope="module")
def extent_or_blur(captures: CaptureSet, doubts: Doubts) -> Doubts:
    """The same doubt with the extent as the best explanation: which of the two is, rounding decides."""
    rival = Rival("spatial_coherence", "sensor_blur", fitted(captures, "sensor_blur"))
    return replace(doubts, model=fitted(captures, "spatial_coherence"), rivals=(rival,))


def fitted(captures: CaptureSet, name: str) -> Model:
    """The model with one effect, fitted."""
    model = Model(captures.bench).having(absent(KNOWN[name], captures.bench))
    return fit(model, [name], load(captures, fit_rows(captures))).model


def said(
    captures: CaptureSet, one: PossibleCapture, model: Model, *rivals: Model
) -> list[ExpectedInformation]:
    return information_of_possible(captures.folder, one, model, rivals, 0.0)


def shown(
    captures: CaptureSet, plane_mm: float = 8.0, exposures: tuple[float, ...] = (20.0,)
) -> PossibleCapture:
    gray = pattern_of_kind(captures.bench, "green", plane_mm, "rough_picture", 3).gray
    return PossibleCapture("green", plane_mm, "rough_picture", gray, exposures, 0)


def test_every_kind_of_pattern_can_be_asked_for_and_comes_again() -> None:
    bench = small_bench()
    for kind in PATTERN_KINDS:
        first, again, other = (pattern_of_kind(bench, "green", 6.0, kind, turn).gray for turn in (0, 0, 1))
        assert first.shape == bench.panel.shape and first.dtype == np.uint8
        assert np.array_equal(first, again)
        assert not np.array_equal(first, other)


def test_what_can_be_captured_has_all_planes_and_exposures_and_nothing_that_was_shown(
    captures: CaptureSet,
) -> None:
    found = possible_captures(captures, [8.0, 12.8], 4)
    assert {one.plane_mm for one in found} == {8.0, 12.8}
    assert {one.kind for one in found} == set(PATTERN_KINDS)
    usual = captures.captures[0].exposure_ms
    assert all(one.exposures_ms[one.usual] == usual for one in found)
    times = np.array([0.25, 0.5, 1, 2, 4, 8])
    assert all(np.allclose(one.exposures_ms, usual * times, rtol=1e-3) for one in found)
    there = {captures.gray(c).tobytes() for c in captures.captures}
    assert not there & {one.gray.tobytes() for one in found if one.plane_mm == 8.0}
    assert len({(one.plane_mm, one.gray.tobytes()) for one in found}) == len(found)
    short = possible_captures(captures, [8.0], 4, limits_ms=(0.02, usual))
    assert all(max(one.exposures_ms) == usual for one in short)
    assert len(possible_captures(captures, [8.0], 40)) >= 40


def test_the_errors_that_are_expected_are_those_of_the_fit(tmp_path: Path) -> None:
    """On pictures with shot noise, which a fit of squared counts does not weigh by its size."""
    effect = KNOWN["zero_order"]
    truth = {"leak_real": 0.06, "leak_imaginary": -0.03, "fill_factor": 0.95}
    captures = captures_with(tmp_path / "captures", effect, truth)
    rows = fit_rows(captures)
    start = Model(captures.bench).having(instance_with(effect, captures.bench, truth))
    found = fit(start, [effect.name], load(captures, rows))
    ids = tuple(c.capture for c in rows)
    what = information_of_captures(captures.folder, ids, found.model, (), 0.0)
    normal, scatter = (
        prior(found.model) + sum(m) for m in zip(*((w.normal, w.scatter) for w in what), strict=True)
    )
    scales = [effect.parameter(p).scale for _, p, _ in found.keys]
    expected = np.sqrt(np.diag(covariance(normal, scatter)))[: len(scales)] * scales
    assert expected == pytest.approx(np.sqrt(np.diag(found.covariance))[: len(scales)], rel=0.05)


def precision(one: ExpectedInformation) -> float:
    """One over the variance of the first number, if the others are known."""
    return float(one.normal[0, 0] ** 2 / one.scatter[0, 0]) if one.scatter[0, 0] else 0.0


def test_more_light_says_more_and_saturated_pixels_say_nothing(captures: CaptureSet) -> None:
    model = fitted(captures, "spatial_coherence")
    usual = captures.captures[0].exposure_ms
    dark, light, blind = said(captures, shown(captures, exposures=(usual / 4, usual, 1e6)), model)
    assert 3 < precision(light) / precision(dark) < 20
    assert dark.saturated <= light.saturated < 0.05
    assert blind.saturated > 0.99
    assert precision(blind) < 1e-3 * precision(light)


def test_a_rival_that_other_numbers_imitate_cannot_be_told(captures: CaptureSet) -> None:
    """An effect with another value differs, but its own numbers take that up: no capture tells it apart."""
    model = fitted(captures, "spatial_coherence")
    present = model.instance("spatial_coherence")
    nearly = {n: v * 1.01 if n.startswith("extent") else v for n, v in present.values.items()}
    same = replace(model, present=(present.with_values(nearly),))
    # At this plane, 8 mm away, a mrad is a pixel of 8 um: the same blur, in the halo, which takes nothing at the iris.
    halo = {n: np.zeros_like(v) for n, v in present.values.items()}
    halo |= {"halo": np.array(0.5), "halo_extent": np.full_like(present.values["halo_extent"], 0.3)}
    names = {"extent_y": "width_y", "extent_x": "width_x", "halo_extent": "halo_width"}
    alike = {names.get(n, n): v for n, v in halo.items()}
    iris = absent(KNOWN["iris"], captures.bench)  # both on the grid that a source with an extent has
    source = replace(model, present=(present.with_values(halo), iris))
    blurring = fitted(captures, "sensor_blur").instance("sensor_blur").with_values(alike)
    blur = replace(model, present=(blurring, iris))

    def told(plane_mm: float, model: Model, rival: Model) -> float:
        (one,) = said(captures, shown(captures, plane_mm), model, rival)
        matrix = one.rivals[0] + np.pad(prior(rival), (0, 1))
        along = np.linalg.solve(matrix[:-1, :-1], matrix[:-1, -1])
        return float(matrix[-1, -1] - matrix[:-1, -1] @ along)

    (off,) = said(captures, shown(captures), model, same)
    assert off.rivals[0][-1, -1] > 1.0
    assert told(8.0, model, same) < 0.05 * off.rivals[0][-1, -1]
    ids = tuple(c.capture for c in fit_rows(captures))
    here = information_of_captures(captures.folder, ids, source, (blur,), 0.0)
    assert all(one.difference[0] < 1e-6 for one in here)
    assert told(12.8, source, blur) > 1000 * told(8.0, source, blur)


def test_a_plane_that_is_too_far_is_left_out(captures: CaptureSet) -> None:
    assert {one.plane_mm for one in possible_captures(captures, [8.0, 9000.0], 1)} == {8.0}
    with pytest.raises(InputError, match="for the planes 9000 mm"):
        possible_captures(captures, [9000.0], 1)


def test_the_doubt_is_named(doubts: Doubts) -> None:
    assert doubts.diagnosis.verdict == "missing"
    assert [{r.of, r.name} for r in doubts.rivals] == [{"spatial_coherence", "sensor_blur"}]
    assert not doubts.decided


def test_the_first_captures_are_two_where_the_rivals_part(
    captures: CaptureSet, extent_or_blur: Doubts
) -> None:
    """At the set's own plane an extent is a blur; elsewhere not. The second is there to judge by."""
    with open_pool(1) as pool:
        found = next_captures(captures, extent_or_blur, possible_captures(captures, [8.0, 12.8], 3), 3, pool)
    first, second, third = found.chosen
    assert first.plane_mm == second.plane_mm == 12.8
    assert "sensor_blur" in first.why and "spatial_coherence" in first.why
    assert "to judge by" in second.why
    assert first.expected_gain > 2 * second.expected_gain > 0
    assert second.expected_gain >= third.expected_gain > 0
    assert len({one.gray.tobytes() for one in found.chosen}) == 3


def test_without_rivals_the_captures_sharpen_the_numbers(
    captures: CaptureSet, extent_or_blur: Doubts
) -> None:
    alone = replace(extent_or_blur, rivals=())
    with open_pool(1) as pool:
        found = next_captures(captures, alone, possible_captures(captures, [8.0], 2), 2, pool)
    assert all("sharpens spatial_coherence" in one.why or "extent" in one.why for one in found.chosen)
    judge, better = found.chosen
    assert holds_out(len({c.pattern for c in captures.captures}))
    assert "to judge by" in judge.why and "to judge by" not in better.why
    assert better.expected_gain > judge.expected_gain > 0
    assert 0 < found.parameter_excess < 2e-4


def test_an_effect_that_is_in_the_model_is_doubted_too(captures: CaptureSet) -> None:
    known = {n: KNOWN[n] for n in ("spatial_coherence", "sensor_blur", "zero_order")}
    for name, other in (("spatial_coherence", "sensor_blur"), ("sensor_blur", "spatial_coherence")):
        with open_pool(1) as pool:
            found = doubts_of(captures, fitted(captures, name), known, pool)
        assert found.diagnosis.verdict == "complete"
        assert [(r.of, r.name) for r in found.rivals] == [(name, other)]
        assert found.model.names == (name,)


def test_a_part_of_a_set_is_explained_as_if_it_were_the_whole(captures: CaptureSet, tmp_path: Path) -> None:
    part = replace(captures, captures=captures.captures[:-1])
    (tmp_path / "copy").mkdir()
    copy = copy_captures(part, tmp_path / "copy")
    known = {n: KNOWN[n] for n in FEW}
    with open_pool(1) as pool:
        one, other = (explain(c, Model(c.bench), known, pool) for c in (part, copy))
    assert [s.as_json() for s in one.steps] == [s.as_json() for s in other.steps]
    assert len(one.model.names) == 1


def test_a_model_that_has_every_effect_there_is_gets_its_verdict(captures: CaptureSet) -> None:
    model = fitted(captures, "spatial_coherence")
    with open_pool(1) as pool:
        found = diagnose(captures, model, {"spatial_coherence": KNOWN["spatial_coherence"]}, pool)
    assert found.verdict == "complete" and found.ranking == ()


def test_a_distance_at_one_plane_may_be_a_wavelength(tmp_path: Path) -> None:
    """Until a second plane is captured, where the two differ."""
    spec = bench_file(tmp_path, 'kind = "distance"\noffset_mm = 0.2', width=96, height=64, distance_mm=8)
    acquire_from(str(spec), tmp_path / "captures", patterns=4)
    captures = read_captures(tmp_path / "captures")
    known = {n: KNOWN[n] for n in ("distance", "wavelength", "zero_order")}
    with open_pool(1) as pool:
        found = doubts_of(captures, Model(captures.bench), known, pool)
        assert [(r.of, r.name) for r in found.rivals] == [("distance", "wavelength")]
        first = next_captures(captures, found, possible_captures(captures, [8.0, 4.8], 1), 1, pool).chosen[0]
    assert first.plane_mm == 4.8
    assert isinstance(found.rivals[0], Rival)


def test_a_copy_of_a_set_says_the_same_and_ids_are_new(captures: CaptureSet, tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    copy = copy_captures(captures, tmp_path / "copy")
    assert copy.bench == captures.bench
    for one, other in zip(copy.captures, captures.captures, strict=True):
        assert np.array_equal(copy.counts(one), captures.counts(other))
        assert np.array_equal(copy.gray(one), captures.gray(other))
        assert (one.capture, one.time_s, one.extra) == (other.capture, other.time_s, other.extra)
    named = replace(captures, captures=(replace(captures.captures[0], capture="next-000"),))
    assert new_ids(named, 2) == ["next-001", "next-002"]


@pytest.mark.slow
def test_the_study_of_captures_needed_finds_half(tmp_path: Path) -> None:
    """The bench of these tests: two further captures where twelve usual ones do not decide."""
    from tests.campaigns.captures_needed import measure

    with open_pool(1) as pool:
        found = measure(0, tmp_path, pool)
    assert found.usual is None and found.chosen is not None and found.chosen <= 8
    assert found.errors_as_small is not None and found.errors_as_small <= 8
    assert json.dumps(found.hidden)
