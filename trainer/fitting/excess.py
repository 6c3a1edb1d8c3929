"""How far a model is off: error beyond the camera's noise, with intervals from the picture's tiles.

excess = (mean squared error - expected noise variance) / variance of the measured signal, saturated pixels left
out; 0 is perfect. Sums are kept by tile, so that the difference of two models on the same captures has a standard
error: tiles of a speckled picture are nearly independent, and the sum over many of them is close to normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from trainer.captures.batches import Batch

TILE = 20  # pixels; several speckles wide, a few hundred tiles a picture


@dataclass(frozen=True)
class Errors:
    """Sums over held-out (or fitted) captures.

    squared [K, tiles]: weighted squared error a capture and tile. noise, variance, pixels [K]: expected noise
    variance, variance of the signal (both summed over pixels) and number of pixels that count, a capture.
    """

    ids: tuple[str, ...]
    squared: Tensor
    noise: Tensor
    variance: Tensor
    pixels: Tensor

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
        """What `nrmse` would be with nothing but the camera's noise."""
        return math.sqrt(float(self.noise.sum() / self.variance.sum()))

    def by_capture(self) -> list[float]:
        """Excess of each capture."""
        return ((self.squared.sum(-1) - self.noise) / self.variance).tolist()


@dataclass(frozen=True)
class Removed:
    """Excess that one model has and another has not, with its standard error."""

    value: float
    error: float

    def interval(self, confidence: float = 0.95, candidates: int = 1) -> tuple[float, float]:
        """Two-sided interval at a confidence, corrected for the number of candidates tried (Bonferroni)."""
        z = NormalDist().inv_cdf(1 - (1 - confidence) / (2 * candidates))
        return self.value - z * self.error, self.value + z * self.error


def errors_of(batch: Batch, prediction: Tensor) -> Errors:
    """Errors of predicted counts [B, h, w] on a batch."""
    squared = batch.weight * (batch.signal - prediction) ** 2
    count = batch.weight.sum((-2, -1)).clamp(min=1)  # a capture saturated throughout says nothing
    mean = (batch.weight * batch.signal).sum((-2, -1)) / count
    variance = (batch.weight * (batch.signal - mean[:, None, None]) ** 2).sum((-2, -1))
    noise = (batch.weight * batch.noise).sum((-2, -1))
    return Errors(batch.ids, tiles(squared).double(), noise.double(), variance.double(), count.double())


def join(parts: list[Errors]) -> Errors:
    """Errors over several batches."""
    return Errors(
        tuple(i for part in parts for i in part.ids),
        torch.cat([p.squared for p in parts]),
        torch.cat([p.noise for p in parts]),
        torch.cat([p.variance for p in parts]),
        torch.cat([p.pixels for p in parts]),
    )


def removed(before: Errors, after: Errors) -> Removed:
    """Excess that `after` removes from `before`, on the same captures.

    The standard error is that of a sum of independent tiles, each tile's difference taken about the mean.
    """
    difference = (before.squared - after.squared).reshape(-1) / float(before.variance.sum())
    count = difference.numel()
    return Removed(float(difference.sum()), float(difference.std()) * math.sqrt(count))


def tiles(values: Tensor, size: int = TILE) -> Tensor:
    """Sums over tiles of `size` x `size` pixels: [B, h, w] to [B, tiles]; a rest at the border is a smaller tile."""
    height, width = values.shape[-2:]
    padded = torch.nn.functional.pad(values, (0, -width % size, 0, -height % size))
    rows, columns = padded.shape[-2] // size, padded.shape[-1] // size
    return padded.reshape(-1, rows, size, columns, size).sum((2, 4)).reshape(-1, rows * columns)
