"""The distance at which captures fit their patterns, searched globally.

A fit of the distance reaches as far as the pictures' depth of focus, a few pitch^2 / wavelength. Beyond it, the error
has many local minima. The correlation of the ideal prediction with the measured pictures is wider: it shows the right
distance from about 20 pitch^2 / wavelength away (2.5 mm for 8 um and 520 nm).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench
from trainer.captures.conventions import Predict, Sample, central_part, flattened, tile_correlations
from trainer.kept_results import forgotten_afterwards

NEAREST, FARTHEST = 0.2, 5.0  # distances that are searched, as shares of the stated one
MOST_STEPS = 120
# Correlation from which the right distance is uphill. More than 70 pitch^2 / wavelength from it, 0.23 was the most in
# 48 sets of 128 x 96 pixels, where chance does most; at it, strong faults leave 0.45.
GOOD = 0.35
NEAR = (-24.0, -8.0, 8.0, 24.0)  # tried after the stated one, pitch^2 / wavelength from it
STEP, FINEST = 16.0, 0.5  # of the search and of its refinement, pitch^2 / wavelength


@dataclass(frozen=True)
class DistanceFit:
    """A distance, and how well captures fit their patterns there.

    Attributes
    ----------
    distance_mm : float, mm
        Panel to image plane.
    correlation : float
        Of predicted and measured pictures, -1 to 1.
    """

    distance_mm: float
    correlation: float


def best_distance(
    bench: Bench, samples: Sequence[Sample], predict: Predict, finest: float = FINEST
) -> DistanceFit | None:
    """The distance at which captures of one colour and plane fit their patterns best.

    Parameters
    ----------
    bench : Bench
    samples : sequence of Sample
        Of one colour and one stated plane. The whole range is searched on the first that has structure.
    predict : callable
        The ideal model: (bench, gray, channel, plane_mm) -> irradiance [h, w] on any scale.
    finest : float, pitch^2 / wavelength
        How finely the best place is searched.

    Returns
    -------
    DistanceFit or None
        None where no sample has structure.
    """
    stated = samples[0].plane_mm
    pitch, wave = bench.panel.pitch, bench.channel(samples[0].channel).wavelength
    unit = 1e3 * pitch**2 / (wave * min(1.0, bench.iris.half_width) ** 2)
    scores = [s for s in (_score(bench, sample, stated, predict) for sample in samples) if s is not None]
    if not scores:
        return None

    def score(distance: float, among: int = len(scores)) -> DistanceFit:
        with forgotten_afterwards():
            return DistanceFit(distance, float(np.mean([one(distance) for one in scores[:among]])))

    best = score(stated)
    if best.correlation < GOOD:
        best = max((best, *(score(stated + step * unit) for step in NEAR)), key=_correlation)
    if best.correlation < GOOD:
        low, high = NEAREST * abs(stated), FARTHEST * abs(stated)
        count = int(min(MOST_STEPS, np.ceil((high - low) / (STEP * unit)))) + 1
        # The farthest, which need most memory, first: what they leave has room for the others.
        far = sorted(
            (score(d, 1) for d in np.copysign(np.linspace(high, low, count), stated)), key=_correlation
        )
        best = max((best, *(score(one.distance_mm) for one in far[-2:])), key=_correlation)
    step = STEP / 2
    while step >= finest:
        beside = max((score(best.distance_mm + sign * step * unit) for sign in (-1, 1)), key=_correlation)
        if beside.correlation > best.correlation:
            best = beside
        else:
            step /= 2
    return best


def _correlation(one: DistanceFit) -> float:
    return one.correlation


def _score(bench: Bench, sample: Sample, stated: float, predict: Predict) -> Callable[[float], float] | None:
    """The mean correlation of a sample's tiles by distance, mm; None for a pattern that makes no structure."""
    near, gray, image, valid, core = central_part(bench, replace(sample, plane_mm=FARTHEST * stated))
    measured = flattened(image, valid)

    def predicted(distance: float) -> np.ndarray:
        made = np.asarray(predict(near, gray, sample.channel, distance), dtype=np.float32)[core]
        return flattened(made, np.ones(made.shape, bool))

    if not predicted(stated).any():
        return None

    def score(distance: float) -> float:
        if distance * stated <= 0:
            return -1.0
        try:
            return float(np.mean(tile_correlations(measured, valid, predicted(distance))[0]))
        except InputError:  # the sampling does not reach this plane
            return -1.0

    return score
