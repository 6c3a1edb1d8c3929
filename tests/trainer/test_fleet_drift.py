"""What drifts together: found where it is so, and only there."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.trainer.made_fleet import fitted, result
from trainer.effects.effect_catalogue import catalogue
from trainer.fleet.drift import LEAST, Drift, DriftPair, drift_of
from trainer.fleet.fleet_page import write_page_of_fleet
from trainer.fleet.fleet_words import doubts, drift_sentence
from trainer.fleet.rank_correlation import interval, spearman
from trainer.fleet.set_result import SetResult

KNOWN = catalogue()
RNG = np.random.default_rng(4)


def fleet(headsets: int, sessions: int, between: float, within: float, seed: int = 0) -> list[SetResult]:
    """Sets in which `warm` and `cool` go with one cause, between headsets and within each, and `third` does not."""
    rng = np.random.default_rng(seed)
    results = []
    for h in range(headsets):
        cause, third = rng.standard_normal(2)
        for s in range(sessions):
            here, other = rng.standard_normal(2)
            common = between * cause + within * here
            numbers = (
                fitted("warm", "size", 1.0 + 0.1 * common + 0.01 * rng.standard_normal(), absent=1.0),
                fitted("cool", "size", -0.2 * common + 0.02 * rng.standard_normal()),
                fitted("third", "size", 0.1 * (between * third + within * other)),
            )
            results.append(result(f"unit-{h:02d}", s, *numbers))
    return results


def pair(drift: Drift, one: str, other: str) -> DriftPair:
    return next(p for p in drift.pairs if set(p.effects) == {one, other})


def test_two_effects_that_drift_together_over_headsets_are_found_and_a_third_is_not() -> None:
    drift = drift_of(fleet(30, 1, between=1, within=0), "headsets", KNOWN)
    first = drift.pairs[0]
    assert set(first.effects) == {"warm", "cool"}
    assert first.together
    assert first.correlation < -0.9
    assert first.ci95[0] < first.correlation < first.ci95[1] < -0.8
    assert len(first.first.values) == 30
    assert drift.tried == 3
    for other in ("warm", "cool"):
        assert not pair(drift, other, "third").together
    assert "cool and warm" in drift_sentence(drift)
    assert "third" not in drift_sentence(drift)
    assert not drift_of(fleet(30, 1, 1, 0), "time", KNOWN).enough


def test_over_time_what_makes_headsets_differ_plays_no_part() -> None:
    """Headsets differ in one way; in each of them, numbers move independently of each other."""
    results = []
    for h in range(12):
        cause = RNG.standard_normal()
        for s in range(6):
            a, b = RNG.standard_normal(2)
            numbers = (fitted("warm", "size", cause + 0.1 * a), fitted("cool", "size", cause + 0.1 * b))
            results.append(result(f"unit-{h}", s, *numbers))
    over_headsets, over_time = (drift_of(results, over, KNOWN) for over in ("headsets", "time"))
    assert over_headsets.pairs[0].together
    assert not over_time.pairs[0].together
    assert abs(over_time.pairs[0].correlation) < 0.4
    assert (over_headsets.count, over_time.count) == (12, 60)


def test_what_drifts_in_each_headset_is_found_though_headsets_differ_otherwise() -> None:
    results = []
    for h in range(4):
        one, other = 10 * RNG.standard_normal(2)
        for s in range(6):
            cause = RNG.standard_normal()
            numbers = (fitted("warm", "size", one + 0.1 * cause), fitted("cool", "size", other - 0.1 * cause))
            results.append(result(f"unit-{h}", s, *numbers))
    drift = drift_of(results, "time", KNOWN)
    assert drift.pairs[0].together
    assert drift.pairs[0].correlation < -0.95
    assert not drift_of(results, "headsets", KNOWN).enough


def test_too_few_say_nothing_and_the_page_says_so(tmp_path: Path) -> None:
    results = fleet(LEAST - 1, 1, 1, 0)
    drifts = [drift_of(results, over, KNOWN) for over in ("headsets", "time")]
    assert all(d.pairs == () and not d.enough for d in drifts)
    assert f"9 headsets, and it takes {LEAST}" in drift_sentence(drifts[0])
    write_page_of_fleet(tmp_path / "page.html", "t.parquet", results, drifts, "explain")
    page = (tmp_path / "page.html").read_text()
    assert "too little to say what drifts together" in page
    assert drift_of(fleet(LEAST, 1, 1, 0), "headsets", KNOWN).enough


def test_a_number_that_spreads_by_no_more_than_its_error_is_not_compared() -> None:
    """The errors of one fit hang together: they alone would look like drift."""
    results = []
    for h in range(40):
        shared = 1e-3 * RNG.standard_normal()
        numbers = (fitted("warm", "size", 0.5 + shared), fitted("cool", "size", 0.5 - shared))
        results.append(result(f"unit-{h}", 0, *numbers))
    drift = drift_of(results, "headsets", KNOWN)
    assert drift.tried == 0
    assert not any(d.varies for d in drift.departures)
    assert "no number varies by more than the fits' errors" in drift_sentence(drift)


def test_a_correlation_that_errors_could_make_does_not_count() -> None:
    """Two independent numbers whose fits share an error of two fifths of their spread."""
    results = []
    for h in range(4000):
        shared, a, b = RNG.standard_normal(3)
        numbers = (
            fitted("warm", "size", a + 0.4 * shared, 0.4),
            fitted("cool", "size", b + 0.4 * shared, 0.4),
        )
        results.append(result(f"unit-{h}", 0, *numbers))
    found = drift_of(results, "headsets", KNOWN).pairs[0]
    assert found.ci95[0] > 0  # beyond chance
    assert found.by_error == pytest.approx(0.16 / 1.16, abs=0.02)
    assert not found.together


def test_the_sign_of_a_parameter_that_no_capture_can_tell_plays_no_part() -> None:
    even = next((e.name, p.name) for e in KNOWN.values() for p in e.parameters if p.even)
    results = []
    for h in range(20):
        cause, sign = RNG.uniform(1, 3), RNG.choice([-1, 1])
        results.append(result(f"u{h}", 0, fitted(*even, sign * cause), fitted("warm", "size", cause)))
    found = drift_of(results, "headsets", KNOWN).pairs[0]
    assert found.together
    assert found.correlation == pytest.approx(1)


def test_one_wrong_fit_neither_makes_nor_hides_drift() -> None:
    values = RNG.normal(size=(30, 2))
    independent = [
        result(f"u{h}", 0, fitted("warm", "size", a), fitted("cool", "size", b))
        for h, (a, b) in enumerate(values)
    ]
    wild = result("wild", 0, fitted("warm", "size", 1e4), fitted("cool", "size", 1e4))
    assert not drift_of([*independent, wild], "headsets", KNOWN).pairs[0].together
    other = result(
        "wild", 0, fitted("warm", "size", 1e4), fitted("cool", "size", 1e4), fitted("third", "size", 0)
    )
    assert pair(drift_of([*fleet(30, 1, 1, 0), other], "headsets", KNOWN), "warm", "cool").together


def test_among_many_independent_effects_few_fleets_show_any_pair() -> None:
    """The level of 0.05 is shared among all pairs: 200 fleets of six effects of 12 headsets."""
    wrong = 0
    for seed in range(200):
        values = np.random.default_rng(seed).standard_normal((12, 6))
        results = [
            result(f"u{h}", 0, *(fitted(f"e{k}", "size", v) for k, v in enumerate(row)))
            for h, row in enumerate(values)
        ]
        drift = drift_of(results, "headsets", KNOWN)
        assert drift.tried == 15
        wrong += any(p.together for p in drift.pairs)
    assert wrong <= 20  # 10 expected; more than 20 by chance: 0.0009


def test_intervals_hold_the_truth_nineteen_times_of_twenty() -> None:
    rng = np.random.default_rng(1)
    truth, held = 6 / np.pi * np.arcsin(0.7 / 2), 0  # Spearman's, of a normal pair whose correlation is 0.7
    for _ in range(500):
        x = rng.standard_normal(25)
        y = 0.7 * x + np.sqrt(1 - 0.49) * rng.standard_normal(25)
        low, high = interval(spearman(x, y), 25)
        held += low < truth < high
    assert 0.92 < held / 500 < 0.98
    assert spearman(np.ones(5), np.arange(5)) == 0
    assert interval(0.5, 20, tried=100)[0] < interval(0.5, 20)[0]


def test_the_page_shows_pairs_failures_and_doubts(tmp_path: Path) -> None:
    results = fleet(15, 3, 1, 0.5)
    results[4] = result("unit-01", 1, failed="image 'image/<b>.png' is not there")
    results[7] = replace(results[7], verdict="outside_catalogue", indistinguishable=(("warm", "cool"),))
    drifts = [drift_of(results, over, KNOWN) for over in ("headsets", "time")]
    write_page_of_fleet(tmp_path / "page.html", "fleet.parquet", results, drifts, "explain")
    page = (tmp_path / "page.html").read_text()
    assert "<b>.png" not in page
    assert "image/&lt;b&gt;.png" in page
    assert len(re.findall("<svg", page)) >= 6  # two charts of pairs, points of each, over time, effects
    assert "cool and warm" in page
    assert "1 failed" in page
    assert "1 of 44 finished sets are not complete" in page
    assert "src=" not in page and "http" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)
    one = [replace(r, facts=replace(r.facts, headset="same", time_from="file")) for r in results]
    said = " ".join(doubts(one, "explain"))
    assert "count as one headset at several times" in said
    assert "44 of 44 sets is that of their first picture's file" in said
