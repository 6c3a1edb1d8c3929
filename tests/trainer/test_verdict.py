"""Intervals hold what they promise, and noise alone is not explained."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from runtime.excess import TILE, PredictionErrors, RemovedExcess, joined, removed_excess, tile_sums
from trainer.captures.batches import Batch
from trainer.diagnosis.verdict import Thresholds

CANDIDATES = 18  # as many as the catalogue has
REAL = Thresholds(share=0, excess=0)  # asks only whether an improvement is real, not whether it matters

Draw = Callable[[np.random.Generator, tuple[int, int]], np.ndarray]


def errors(squared: np.ndarray, variance: float = 1.0) -> PredictionErrors:
    """Errors of captures [K, tiles] whose signal has this variance, a capture, and no noise."""
    count = np.full(len(squared), float(squared.shape[1]))
    ids = tuple(f"{k:03d}" for k in range(len(squared)))
    return PredictionErrors(
        ids, np.asarray(squared, np.float64), 0 * np.asarray(squared, np.float64), 0 * count + variance, count
    )


@pytest.mark.parametrize(
    ("mean", "draw"),
    [
        (0.7, lambda rng, shape: rng.normal(0.7, 2.0, shape)),
        (-1.0, lambda rng, shape: rng.normal(-1.0, 0.3, shape)),
        (2.0, lambda rng, shape: rng.gamma(2.0, 1.0, shape)),  # lopsided, as squared errors are
        (0.0, lambda rng, shape: rng.standard_t(5, shape)),
        (1.0, lambda rng, shape: rng.normal(1, 1, shape) * np.resize([0.7, 1.3], shape[1])),
    ],
    ids=["normal", "worse", "lopsided", "outliers", "bright and dark tiles"],
)
def test_the_interval_of_a_difference_holds_its_mean_as_often_as_it_says(mean: float, draw: Draw) -> None:
    rng = np.random.default_rng(3)
    shape, variance, runs = (4, 60), 37.0, 4000
    true = mean * shape[1] / variance  # over captures of equal variance
    held = 0
    for _ in range(runs):
        after = rng.gamma(4.0, 1.0, shape)
        removed = removed_excess(errors(after + draw(rng, shape), variance), errors(after, variance))
        low, high = removed.interval()
        held += low <= true <= high
    assert 0.93 < held / runs < 0.97


def test_a_difference_is_that_of_the_excesses_and_errors_shrink_with_captures() -> None:
    rng = np.random.default_rng(0)
    one, other = rng.gamma(4, 1, (3, 50)), rng.gamma(3, 1, (3, 50))
    removed = removed_excess(errors(one, 9), errors(other, 9))
    assert removed.value == pytest.approx(errors(one, 9).excess - errors(other, 9).excess)
    assert removed_excess(errors(other, 9), errors(one, 9)).value == pytest.approx(-removed.value)
    assert removed_excess(errors(one), errors(one)).interval() == (0, 0)
    more = removed_excess(joined([errors(one, 9)] * 4), joined([errors(other, 9)] * 4))
    assert more.value == pytest.approx(removed.value)
    assert more.error == pytest.approx(removed.error / 2, rel=0.02)


def test_intervals_widen_with_confidence_and_candidates() -> None:
    removed = RemovedExcess(1.0, 0.1)
    assert removed.interval() == pytest.approx((1 - 0.196, 1 + 0.196), abs=1e-4)
    assert removed.interval(0.95, 20) == pytest.approx(removed.interval(1 - 0.05 / 20))
    lows = [removed.interval(c, k)[0] for c, k in ((0.9, 1), (0.95, 1), (0.95, 2), (0.95, 18), (0.999, 18))]
    assert lows == sorted(lows, reverse=True)


def test_tiles_keep_the_sum_whatever_the_shape() -> None:
    rng = np.random.default_rng(0)
    for shape in ((20, 40), (21, 39), (5, 7), (1, 100), (96, 128)):
        values = rng.normal(size=(2, *shape))
        found = tile_sums(values)
        assert found.shape == (2, math.ceil(shape[0] / TILE), math.ceil(shape[1] / TILE))
        assert found.sum((1, 2)) == pytest.approx(values.sum((1, 2)))


# --- nothing is missing: camera noise on a right prediction ---

SHAPE = (60, 100)
CAPTURES = 5


def noisy(rng: np.random.Generator, prediction: np.ndarray) -> Batch:
    """Captures of a camera that measures exactly what is predicted [K, h, w], with shot and read noise."""
    variance = 0.4 * prediction + 4.0
    signal = rng.poisson(prediction / 0.4) * 0.4 + rng.normal(0, 2.0, prediction.shape)
    kinds = [torch.as_tensor(a, dtype=torch.float32) for a in (signal, np.ones_like(signal), variance)]
    gray = torch.zeros((len(prediction), 1, 1), dtype=torch.int32)
    return Batch(
        "green",
        10.0,
        tuple(map(str, range(len(prediction)))),
        gray,
        *kinds,
        torch.ones(len(prediction)),
        1.0,
        lambda: gray[:, None],
    )


def columns(rng: np.random.Generator, speckle: np.ndarray) -> list[np.ndarray]:
    """What candidates would change in the pictures: smooth maps, the picture itself displaced, and noise."""
    y, x = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j]
    smooth = [speckle * m for m in (y, x, y * x, y**2, x**2, y**3)]
    displaced = [
        np.roll(speckle, s, (1, 2)) - speckle for s in ((0, 1), (1, 0), (0, 9), (5, 0), (3, 3), (9, -4))
    ]
    noise_maps = [rng.normal(size=speckle.shape) * speckle for _ in range(CANDIDATES - 12)]
    return [*smooth, *displaced, *noise_maps]


@pytest.mark.parametrize(
    "fitted", [True, False], ids=["fitted to other captures", "a very small share of it"]
)
def test_noise_alone_is_not_worth_adding(fitted: bool) -> None:
    rng = np.random.default_rng(5)
    speckle = rng.gamma(2.0, 150.0, (CAPTURES, *SHAPE))
    prediction = torch.as_tensor(speckle, dtype=torch.float32)
    candidates = [torch.as_tensor(c, dtype=torch.float32) for c in columns(rng, speckle)]
    assert len(candidates) == CANDIDATES
    runs, found, matters = 250, 0, 0
    for _ in range(runs):
        fitted_to, held = noisy(rng, speckle), noisy(rng, speckle)
        before = held.errors(prediction)
        assert abs(before.excess) < 1e-3
        real = []
        for column in candidates:
            if fitted:
                size = float((column * (fitted_to.signal - prediction)).sum() / (column**2).sum())
            else:  # too small to do harm, so that only noise_maps decides: the hardest case
                size = 1e-4 * float(rng.choice([-1, 1]))
            removed = removed_excess(before, held.errors(prediction + size * column))
            real.append(REAL.worth_adding(removed, 0.0, CANDIDATES))
            matters += Thresholds().worth_adding(removed, 1.0, CANDIDATES)
        found += any(real)
    # At most half of the level, as `trainer.diagnosis.verdict` says; three standard deviations of the count above it.
    half = REAL.level / 2
    assert found / runs < half + 3 * math.sqrt(half / runs)
    assert matters == 0


def test_what_is_really_there_is_worth_adding() -> None:
    rng = np.random.default_rng(6)
    speckle = rng.gamma(2.0, 150.0, (CAPTURES, *SHAPE))
    tilt = speckle * np.linspace(-1, 1, SHAPE[1])
    held = noisy(rng, speckle + 0.05 * tilt)
    before, after = (held.errors(torch.as_tensor(p)) for p in (speckle, speckle + 0.05 * tilt))
    assert abs(after.excess) < 1e-3
    assert Thresholds().worth_adding(removed_excess(before, after), before.excess, CANDIDATES)


# --- the edges of the verdicts ---


def test_an_effect_must_be_real_and_matter() -> None:
    t = Thresholds(level=0.05, share=0.02, excess=1e-4)
    assert t.least(0.0) == t.least(0.004) == 1e-4
    assert t.least(0.5) == pytest.approx(0.01)
    assert t.least(-1e-5) == 1e-4  # an ideal model at the noise may lie below zero
    assert t.worth_adding(RemovedExcess(0.02, 0.001), 0.5, 18)
    assert not t.worth_adding(RemovedExcess(0.0099, 1e-6), 0.5, 18)  # real, but too little of what is wrong
    assert not t.worth_adding(RemovedExcess(1e-4, 0.0), 0.0, 18)  # not more than the least
    assert t.worth_adding(RemovedExcess(1.01e-4, 0.0), 0.0, 18)
    assert not t.worth_adding(RemovedExcess(-0.1, 0.001), 0.5, 1)
    for broken in (RemovedExcess(math.nan, 0.1), RemovedExcess(0.1, math.nan)):
        assert not t.worth_adding(broken, 0.5, 18)
    # 2.5 standard errors are enough for one candidate, and for eighteen they are not.
    assert t.worth_adding(RemovedExcess(0.25, 0.1), 0.5, 1)
    assert not t.worth_adding(RemovedExcess(0.25, 0.1), 0.5, 18)
    assert t.worth_adding(RemovedExcess(0.25, 0.1), 0.5, 3) and not t.worth_adding(
        RemovedExcess(0.25, 0.1), 0.5, 5
    )
    assert not Thresholds(level=1e-9).worth_adding(RemovedExcess(0.5, 0.1), 0.5, 1)


def test_a_model_is_complete_below_the_larger_threshold() -> None:
    t = Thresholds(complete_share=0.02, complete_excess=3e-4)
    assert t.complete(2.9e-4, 0.0)
    assert not t.complete(3e-4, 0.0)
    assert t.complete(0.0099, 0.5)
    assert not t.complete(0.01, 0.5)
    assert t.complete(-1e-3, -1e-3)
    assert not t.complete(math.nan, 0.5)


def test_explanations_are_inseparable_where_their_difference_may_be_none() -> None:
    t = Thresholds(excess=1e-4)
    assert t.inseparable(RemovedExcess(0.0, 0.0), 0.0, 1.0)
    assert t.inseparable(RemovedExcess(0.01, 0.01), 0.0, 1.0)
    assert not t.inseparable(RemovedExcess(0.01, 0.001), 0.0, 1.0)
    assert t.inseparable(RemovedExcess(0.99e-4, 1e-9), 0.0, 1.0)  # sure, but too little to choose by
    assert not t.inseparable(RemovedExcess(1e-4, 1e-9), 0.0, 1.0)
    assert t.inseparable(RemovedExcess(-0.1, 0.001), 0.0, 1.0)
    # The level is that of one comparison: 1.97 standard errors separate two explanations, 1.95 do not.
    assert not t.inseparable(RemovedExcess(0.0197, 0.01), 0.0, 1.0)
    assert t.inseparable(RemovedExcess(0.0195, 0.01), 0.0, 1.0)
    # Half of what the better one leaves may be its own wrong shape.
    assert t.inseparable(RemovedExcess(0.0249, 1e-6), 0.05, 1.0)
    assert not t.inseparable(RemovedExcess(0.0251, 1e-6), 0.05, 1.0)
    assert not t.inseparable(RemovedExcess(0.01, 0.001), -1e-5, 1.0)
    # While other effects hide both, what is left says nothing of shapes.
    assert t.inseparable(RemovedExcess(0.0249, 1e-6), 0.5, 0.025)
    assert not t.inseparable(RemovedExcess(0.0251, 1e-6), 0.5, 0.025)


def test_json_has_every_threshold() -> None:
    assert Thresholds().as_json() == {
        "level": 0.05,
        "share": 0.0,
        "excess": 2e-4,
        "complete_share": 0.0,
        "complete_excess": 5e-4,
        "floor": 0.0,
        "pixel_noise": 0.0,
    }


def test_no_threshold_is_below_the_floor_that_the_captures_show() -> None:
    t = Thresholds(floor=1e-3)
    assert not t.worth_adding(RemovedExcess(9e-4, 1e-6), 0.5, 18)
    assert t.worth_adding(RemovedExcess(1.1e-3, 1e-6), 0.5, 18)
    assert t.complete(9e-4, 0.5) and not t.complete(1.1e-3, 0.5)
    assert not t.may_be_worth_adding(9e-4, 0.5)


def test_the_noise_of_pixels_own_values_is_nothing_to_explain() -> None:
    t = Thresholds(pixel_noise=1e-3)
    assert t.complete(1.4e-3, 0.5) and not t.complete(1.6e-3, 0.5)
    assert t.may_be_worth_adding(1.3e-3, 0.5) and not t.may_be_worth_adding(1.1e-3, 0.5)
    assert t.worth_adding(RemovedExcess(2.1e-4, 1e-6), 0.5, 18)  # it hides no other effect
