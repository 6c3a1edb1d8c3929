"""How well light paths predict captures that no fit has seen, and what follows from it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.calibration.drift_fit import Base, Estimate, Shot, gain_of, predicted
from runtime.camera.view import sampler

TILE = 20  # pixels; tiles are taken to err independently
MOST, LEAST = 0.5, 0.0001  # share of what has come in excess, and absolutely: less is not worth a change
LEFT = 0.02  # share of the excess before that may be left
COMPLETE = 0.0003  # excess below which nothing is missing
WRONG = 0.001  # excess above which a light path does not fit: an error of 3 % of the contrast
SURE = 1.96  # standard errors


@dataclass(frozen=True)
class Heldout:
    """Errors of predictions on held-out captures, over the variance of what was measured.

    nrmse: root mean squared error, noise included. noise_nrmse: what the camera's noise alone would give. excess:
    the squared error above the noise, 0 for a perfect light path. tiles: squared errors of tiles, for intervals.
    residuals: the error of each capture in standard deviations of its noise, float32 [h, w].
    """

    nrmse: float
    noise_nrmse: float
    excess: float
    tiles: np.ndarray
    variance: float
    residuals: tuple[np.ndarray, ...]

    def as_json(self) -> dict[str, float]:
        """The numbers."""
        return {"nrmse": self.nrmse, "noise_nrmse": self.noise_nrmse, "excess": self.excess}


def heldout_errors(bases: Mapping[str, Base], shots: Sequence[Shot], estimate: Estimate) -> Heldout:
    """Errors of an estimate on shots, each with its own gain."""
    squared, noise, variance = [], 0.0, 0.0
    residuals = []
    for shot in shots:
        base = bases[shot.channel]
        light = predicted(base, shot, estimate, sampler(estimate.view, base.path.grid))
        use = shot.weight > 0
        error = np.where(use, shot.signal - gain_of(shot, light) * light, 0)
        residuals.append((error * np.sqrt(shot.weight)).astype(np.float32))
        squared.append(_tiled(error.astype(np.float64) ** 2))
        noise += float((1 / shot.weight[use].astype(np.float64)).sum())
        seen = shot.signal[use].astype(np.float64)
        variance += float(((seen - seen.mean()) ** 2).sum())
    tiles = np.concatenate(squared)
    total = float(tiles.sum())
    return Heldout(
        math.sqrt(total / variance),
        math.sqrt(noise / variance),
        (total - noise) / variance,
        tiles,
        variance,
        tuple(residuals),
    )


def removed(before: Heldout, after: Heldout) -> tuple[float, float]:
    """The excess that `after` takes from `before`, and its standard error from the spread of tiles."""
    difference = (before.tiles - after.tiles) / before.variance
    return float(difference.sum()), float(difference.std()) * math.sqrt(difference.size)


def verdict(before: Heldout, after: Heldout, known: float = 0.0) -> str:
    """What is to be done with a refit. known: the excess that the light path had when it was made.

    "recalibrated": the refit predicts better than the light path that was there, surely, and takes away most of what
    has come since: what explains less would only bend parameters towards something else that is wrong. "unchanged":
    what was there predicts about as well as when it was made. "not_explained": it is wrong, and the refit does not
    mend it.
    """
    gone, error = removed(before, after)
    if gone - SURE * error > 0 and gone > max(MOST * (before.excess - known), LEAST):
        return "recalibrated"
    return "unchanged" if before.excess < max(WRONG, 2 * known) else "not_explained"


def complete(before: Heldout, after: Heldout) -> bool:
    """Whether what remains after a refit is too little to matter."""
    return after.excess < max(COMPLETE, LEFT * before.excess)


def _tiled(values: np.ndarray) -> np.ndarray:
    """Sums over tiles of TILE x TILE pixels, [tiles]."""
    rows, columns = (np.arange(0, n, TILE) for n in values.shape)
    return np.add.reduceat(np.add.reduceat(values, rows, 0), columns, 1).ravel()
