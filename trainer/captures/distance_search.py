"""The distance at which captures fit their patterns, searched globally.

A fit of the distance reaches as far as the pictures' depth of focus, a few pitch^2 / wavelength. Beyond it, the error
has many local minima. The correlation of the ideal prediction with the measured pictures is wider: it shows the right
distance from about 20 pitch^2 / wavelength away (2.5 mm for 8 um and 520 nm). Of pictures whose pixels are joined it is
wider by as much as the pixels are: light that is defocused moves details of a picture, and large ones show it later. So
far away, where depths of focus are many, coarse pictures are searched, and ever finer ones about the best place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench
from trainer.captures.block_means import blocks
from trainer.captures.conventions import (
    R_RATIO,
    Predict,
    Sample,
    beyond_chance,
    central_part,
    flattened,
    tile_correlations,
)
from trainer.kept_results import forgotten_afterwards

NEAREST, FARTHEST = 0.2, 5.0  # distances that are searched, as shares of the stated one
RINGS = (1.25, 2.0)  # so far at a time, then all, until one distance stands out
SHOULDER = 3.0  # steps from the best one within which others fit in part
ELSEWHERE = 6  # distances beyond these that say how well pictures fit by chance
MOST_STEPS = 64  # of the search, where pictures can be made as coarse as that takes
SMALLEST = 64  # pixels a side that coarse pictures keep
# Correlation from which the right distance is uphill. More than 70 pitch^2 / wavelength from it, 0.23 was the most in
# 48 sets of 128 x 96 pixels, where chance does most; at it, strong faults leave 0.45.
GOOD = 0.35
NEAR = (-24.0, -8.0, 8.0, 24.0)  # tried after the stated one, depths of focus from it
STEP, FINEST = 16.0, 0.5  # of the search of whole pixels and of its refinement, depths of focus
ACROSS = 1.1  # panels that light may move aside and still reach a picture


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


# Of a sample at a distance, mm, and of pictures with so many pixels joined along each axis.
Correlation = Callable[[float, int], float]


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
    finest : float, depths of focus of the whole band
        How finely the best place is searched.

    Returns
    -------
    DistanceFit or None
        None where no sample has structure.
    """
    stated = samples[0].plane_mm
    several = [
        one
        for one in (_correlation_of(bench, sample, stated, predict) for sample in samples)
        if one is not None
    ]
    if not several:
        return None
    near, _, image, _, _ = _part(bench, samples[0], stated)
    steps = _Steps(near, samples[0].channel, stated, image.shape)

    @cache
    def score(distance: float, joined: int = 1) -> DistanceFit:
        return DistanceFit(distance, float(np.mean([one(distance, joined) for one in several])))

    best, step = score(stated), STEP
    if best.correlation < GOOD:
        beside = (score(stated + depths * steps.depth_of_focus(stated)) for depths in NEAR)
        best = max((best, *beside), key=_correlation)
    if best.correlation < GOOD:
        step = steps.coarse
        likely = (best.distance_mm, *_likely(several[0], steps))
        best = max((score(distance, steps.joined(step)) for distance in likely), key=_correlation)
    step /= 2
    while step * steps.depth_of_focus(best.distance_mm) >= finest * steps.of_whole_band:
        joined, aside = steps.joined(2 * step), step * steps.depth_of_focus(best.distance_mm)
        best = score(best.distance_mm, joined)
        beside = (score(best.distance_mm + sign * aside, joined) for sign in (-1, 1))
        better = max(beside, key=_correlation)
        if better.correlation > best.correlation:
            best = better
        else:
            step /= 2
    return score(best.distance_mm)


def _correlation(one: DistanceFit) -> float:
    return one.correlation


@dataclass(frozen=True)
class _Steps:
    """How far apart distances are tried, in depths of focus: the farther, the more pixels of pictures are joined.

    Attributes
    ----------
    bench : Bench
    channel : str
    stated : float, mm
    picture : (int, int), pixels
        What is compared: rows, columns.
    """

    bench: Bench
    channel: str
    stated: float
    picture: tuple[int, int]

    @cached_property
    def of_whole_band(self) -> float:
        """pitch^2 / wavelength of all light that passes the iris, mm."""
        panel, wave = self.bench.panel, self.bench.channel(self.channel).wavelength
        return 1e3 * panel.pitch**2 / (wave * min(1.0, self.bench.iris.half_width) ** 2)

    def depth_of_focus(self, distance: float) -> float:
        """The same of the light that reaches the picture."""
        passing = min(1.0, self.bench.iris.half_width)
        share = min(passing, _arriving(self.bench, self.channel, distance))
        return self.of_whole_band * (passing / share) ** 2

    def joined(self, step: float) -> int:
        """Pixels to join along each axis."""
        return max(1, min(round(step / STEP / self._pixel), min(self.picture) // SMALLEST))

    @cached_property
    def coarse(self) -> float:
        """The step with which the whole range is searched."""
        between = np.linspace(*self._range, 257)
        whole = float(np.trapezoid([1 / self.depth_of_focus(d) for d in between], between)) / STEP
        return STEP * max(1.0, min(whole / MOST_STEPS, min(self.picture) // SMALLEST * self._pixel))

    def rings(self) -> list[list[float]]:
        """The distances of the whole range, mm, the nearest to the stated one first."""
        low, high = self._range
        found = [low]
        while found[-1] < high:
            found.append(found[-1] + self.coarse * self.depth_of_focus(found[-1]))
        stated = max(abs(self.stated), 1e-9)
        shares = [max(d, 1e-9) / stated for d in found]
        shares = [max(share, 1 / share) for share in shares]
        signed = [float(np.copysign(d, self.stated)) for d in found]
        ends = (0.0, *RINGS, np.inf)
        return [
            [d for d, share in zip(signed, shares, strict=True) if inner < share <= outer]
            for inner, outer in pairwise(ends)
        ]

    @property
    def _range(self) -> tuple[float, float]:
        """The nearest and the farthest distance, mm, without their sign."""
        return NEAREST * abs(self.stated), FARTHEST * abs(self.stated)

    @cached_property
    def _pixel(self) -> float:
        """Side of the camera's pixels at the picture's centre, panel pixels."""
        y, x = ((n - 1) / 2 for n in self.bench.camera.shape)
        there, next_one = (np.array(self.bench.camera.on_panel(y, x + k)) for k in (0.0, 1.0))
        return float(np.linalg.norm(next_one - there))


def _likely(correlation: Correlation, steps: _Steps) -> list[float]:
    """The two distances, mm, at which a sample fits best, of all or of the nearer ones, where one stands out there."""
    joined, tried = steps.joined(steps.coarse), dict[float, float]()
    chance = beyond_chance(math.prod(steps.picture) / joined**2)
    best: list[float] = []
    for ring in steps.rings():
        for distance in ring:
            tried[distance] = correlation(distance, joined)
        best = sorted(tried, key=lambda d: -tried[d])[:2]
        if best:
            near = SHOULDER * steps.coarse * steps.depth_of_focus(best[0])
            others = [tried[d] for d in tried if abs(d - best[0]) > near]
            if len(others) >= ELSEWHERE and tried[best[0]] > max(R_RATIO * max(others), chance):
                break
    return best


def _arriving(bench: Bench, channel: str, distance: float) -> float:
    """Share of the panel's band whose light reaches a picture of the panel's size at a distance, mm."""
    panel, wave = bench.panel, bench.channel(channel).wavelength
    return ACROSS * max(panel.shape) * 2 * panel.pitch**2 / (wave * max(abs(distance), 1e-9) * 1e-3)


def _part(
    bench: Bench, sample: Sample, stated: float
) -> tuple[Bench, NDArray, NDArray, NDArray, tuple[slice, slice]]:
    """`central_part`, with what diffracts into it from the farthest distance."""
    return central_part(bench, replace(sample, plane_mm=FARTHEST * stated))


def _correlation_of(bench: Bench, sample: Sample, stated: float, predict: Predict) -> Correlation | None:
    """The mean correlation of a sample's tiles; None for a pattern that makes no structure."""
    near, gray, image, valid, core = _part(bench, sample, stated)

    @lru_cache(maxsize=4)  # the best distances are compared again with fewer pixels joined
    def predicted(distance: float) -> NDArray:
        # Light at higher frequencies passes by the picture, and room for it would take many times the memory.
        half_width = min(near.iris.half_width, _arriving(near, sample.channel, distance))
        narrowed = replace(near, iris=replace(near.iris, half_width=half_width))
        with forgotten_afterwards():
            return np.asarray(predict(narrowed, gray, sample.channel, distance), dtype=np.float32)[core]

    @lru_cache(maxsize=2)
    def measured(joined: int) -> tuple[NDArray, NDArray]:
        good = blocks(valid.astype(float), joined) > 0.5
        return flattened(np.nan_to_num(blocks(np.where(valid, image, np.nan), joined)), good), good

    def flat(distance: float, joined: int) -> NDArray:
        made = blocks(predicted(distance), joined)
        return flattened(made, np.ones(made.shape, bool))

    if not flat(stated, 1).any():
        return None

    def correlation(distance: float, joined: int) -> float:
        if distance * stated <= 0:
            return -1.0
        picture, good = measured(joined)
        try:
            return float(np.mean(tile_correlations(picture, good, flat(distance, joined))[0]))
        except InputError:  # the sampling does not reach this plane
            return -1.0

    return correlation
