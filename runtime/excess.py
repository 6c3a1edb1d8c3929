"""How far predictions are from captures: error beyond the camera's noise, with intervals from the picture's tiles.

excess = (mean squared error - expected noise variance) / variance of the measured signal, saturated pixels left out;
0 is perfect. Squared errors are kept by tile, so that the difference of two predictions of the same captures has a
standard error: tiles of a speckled picture are nearly independent, and the sum over many of them is close to normal.
The trainer and the headset's self-calibration both use this one statistic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

TILE = 20  # pixels; several speckles wide, a few hundred tiles a picture
CONFIDENCE = 0.95  # of an interval where nothing else is said
COMPLETE_SHARE, COMPLETE_EXCESS = 0.02, 3e-4  # a prediction is complete below the larger of these

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PredictionErrors:
    """Sums over captures of the errors of one prediction.

    Attributes
    ----------
    ids : tuple of str
        The captures, in the order of the arrays' first axis.
    squared, noise : float64 array [captures, tiles], counts^2
        Squared error and expected variance of the camera's noise, both summed over the pixels of each tile that count.
    variance : float64 array [captures], counts^2
        Variance of the signal, summed over the pixels that count.
    pixels : float64 array [captures]
        Number of pixels that count.
    """

    ids: tuple[str, ...]
    squared: Array
    noise: Array
    variance: Array
    pixels: Array

    @property
    def excess(self) -> float:
        """Excess over all captures."""
        return float((self.squared.sum() - self.noise.sum()) / self.variance.sum())

    @property
    def nrmse(self) -> float:
        """Root of the mean squared error over the signal's variance, noise included."""
        return math.sqrt(float(self.squared.sum() / self.variance.sum()))

    @property
    def noise_nrmse(self) -> float:
        """What `nrmse` would be with the camera's noise alone."""
        return math.sqrt(float(self.noise.sum() / self.variance.sum()))

    def interval(self, confidence: float = CONFIDENCE) -> tuple[float, float]:
        """Two-sided interval of the excess, from the spread of the tiles' excess about its mean."""
        beyond = self.squared - self.noise
        if beyond.size < 2:
            return -math.inf, math.inf
        error = math.sqrt(beyond.size) * float(beyond.std(ddof=1)) / float(self.variance.sum())
        z = NormalDist().inv_cdf(0.5 + confidence / 2)
        return self.excess - z * error, self.excess + z * error

    def by_capture(self) -> list[float]:
        """Excess of each capture."""
        return [float(e) for e in (self.squared - self.noise).sum(-1) / self.variance]

    def part(self, which: Sequence[int]) -> PredictionErrors:
        """The errors of some of the captures, by their place."""
        rows = np.asarray(which, dtype=np.intp)
        arrays = (self.squared[rows], self.noise[rows], self.variance[rows], self.pixels[rows])
        return PredictionErrors(tuple(self.ids[k] for k in which), *arrays)

    def as_json(self) -> dict[str, float]:
        """Keys `nrmse`, `noise_nrmse` and `excess`."""
        return {"nrmse": self.nrmse, "noise_nrmse": self.noise_nrmse, "excess": self.excess}


@dataclass(frozen=True)
class RemovedExcess:
    """Excess that one prediction has and another has not.

    Attributes
    ----------
    value : float
    error : float
        Standard error of the value.
    """

    value: float
    error: float

    def interval(self, confidence: float = CONFIDENCE, candidates: int = 1) -> tuple[float, float]:
        """Two-sided interval of the value.

        Parameters
        ----------
        confidence : float, 0 to 1
        candidates : int
            How many were tried, for Bonferroni's correction.
        """
        z = NormalDist().inv_cdf(1 - (1 - confidence) / (2 * candidates))
        return self.value - z * self.error, self.value + z * self.error


def prediction_errors(
    ids: Sequence[str], signal: Any, prediction: Any, noise: Any, mask: Any
) -> PredictionErrors:
    """Errors of predicted counts.

    Parameters
    ----------
    ids : sequence of str
        Names of the captures.
    signal, prediction, noise, mask : arrays [captures, h, w]
        Counts above black, measured and predicted; expected variance of the camera's noise (counts^2); 1 where a pixel
        counts, else 0. NumPy arrays, or tensors in the host's memory.
    """
    signal, prediction, noise, mask = (np.asarray(a) for a in (signal, prediction, noise, mask))
    squared = tile_sums(mask * (signal - prediction) ** 2)
    count = np.maximum(
        mask.sum((-2, -1), dtype=np.float64), 1
    )  # a capture that is saturated everywhere has none
    mean = (mask * signal).sum((-2, -1), dtype=np.float64) / count
    variance = (mask * (signal - mean[:, None, None].astype(signal.dtype)) ** 2).sum(
        (-2, -1), dtype=np.float64
    )
    return PredictionErrors(
        tuple(ids),
        squared.reshape(len(squared), -1),
        tile_sums(mask * noise).reshape(len(squared), -1),
        variance,
        count,
    )


def joined(parts: Sequence[PredictionErrors]) -> PredictionErrors:
    """The errors over all captures of several parts."""
    return PredictionErrors(
        tuple(i for part in parts for i in part.ids),
        np.concatenate([p.squared for p in parts]),
        np.concatenate([p.noise for p in parts]),
        np.concatenate([p.variance for p in parts]),
        np.concatenate([p.pixels for p in parts]),
    )


def removed_excess(before: PredictionErrors, after: PredictionErrors) -> RemovedExcess:
    """Excess that `after` removes from `before`, on the same captures.

    The standard error is that of a sum of independent tiles, each tile's difference taken about the mean.
    """
    difference = ((before.squared - after.squared) / before.variance.sum()).reshape(-1)
    spread = float(difference.std(ddof=1)) if difference.size > 1 else math.inf
    return RemovedExcess(float(difference.sum()), spread * math.sqrt(difference.size))


def is_complete(
    excess: float, reference: float, share: float = COMPLETE_SHARE, least: float = COMPLETE_EXCESS
) -> bool:
    """Whether an excess is too little to explain.

    Parameters
    ----------
    excess, reference : float
        What is left, and what there was before.
    share, least : float
        The excess is too little below the larger of `share` times the reference, and `least`.
    """
    return excess < max(share * reference, least)


def tile_sums(values: np.ndarray, size: int = TILE) -> Array:
    """Sums over tiles of `size` x `size` pixels: [..., h, w] to [..., rows, columns]; the last may be smaller."""
    rows, columns = (np.arange(0, n, size) for n in values.shape[-2:])
    return np.add.reduceat(np.add.reduceat(values, rows, -2, dtype=np.float64), columns, -1)
