"""Where in a set of captures a model is off: over the field, over spatial frequency, over brightness.

Each class takes one capture at a time and keeps only sums. Saturated pixels (mask 0) are left out throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from runtime.excess import tile_sums
from trainer.captures.batches import Batch
from trainer.device import array_of

CELLS = 16  # tiles along the longer side of the picture
RINGS = 0.025  # width of a ring of spatial frequencies, cycles/pixel
STEPS = 20  # most steps of brightness
FINE = 2048  # steps that sums are kept in before they are merged
REACH = (-0.1, 1.4)  # predicted brightness that is resolved, share of full scale

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CaptureResidual:
    """One capture and its prediction.

    Attributes
    ----------
    measured, predicted : float64 array [h, w], counts above black
    noise : float64 array [h, w], counts^2
        Expected variance of the camera's noise.
    mask : float64 array [h, w]
        1, or 0 where saturated.
    """

    measured: Array
    predicted: Array
    noise: Array
    mask: Array

    @property
    def residual(self) -> Array:
        """Measured less predicted, counts; 0 where saturated."""
        return (self.measured - self.predicted) * self.mask

    @property
    def gain(self) -> float | None:
        """Least-squares factor from prediction to measurement; None where nothing was predicted."""
        square = float((self.mask * self.predicted**2).sum())
        return float((self.mask * self.predicted * self.measured).sum()) / square if square > 0 else None


def residual_of(batch: Batch, prediction: Tensor) -> CaptureResidual:
    """The residual of a batch of one capture, from its predicted counts [1, h, w]."""
    tensors = (batch.signal, prediction, batch.noise, batch.mask)
    return CaptureResidual(*(array_of(t[0].double()) for t in tensors))


class FieldSums:
    """Error in square tiles of the picture, about 16 along its longer side."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.tile = max(1, round(max(shape) / CELLS))
        self.shape = (-(-shape[0] // self.tile), -(-shape[1] // self.tile))
        self._above = np.zeros(self.shape)
        self._pixels = np.zeros(self.shape)

    def add(self, capture: CaptureResidual) -> None:
        """Add one capture to the sums."""
        self._above += self._sums(capture.residual**2 - capture.noise * capture.mask)
        self._pixels += self._sums(capture.mask)

    def _sums(self, values: Array) -> Array:
        return tile_sums(values, self.tile)

    def excess(self, variance: float) -> list[list[float | None]]:
        """Excess of each tile, [row][column]; None for a tile that is saturated in every capture.

        Parameters
        ----------
        variance : float, counts^2 a pixel
            Of the measured signal over all captures. It is the same for every tile, so that the mean of the tiles,
            weighted with their pixels, is the excess of the whole.
        """
        if variance <= 0:
            return [[None] * self.shape[1] for _ in range(self.shape[0])]
        return [
            [float(a / (n * variance)) if n else None for a, n in zip(above, pixels, strict=True)]
            for above, pixels in zip(self._above, self._pixels, strict=True)
        ]


class FrequencySums:
    """Power spectra of residual, expected noise and signal, averaged over rings of spatial frequency.

    A Hann window keeps the picture's edges out. A spectrum is scaled so that its mean over all frequencies is
    the mean square, counts^2; noise that is independent from pixel to pixel is flat.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._window = np.outer(_hann(shape[0]), _hann(shape[1]))
        self._norm = float((self._window**2).sum())
        fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
        radius = np.hypot(fy, fx)
        # The corners of the spectrum hold few frequencies: they are counted with the last whole ring.
        self._ring = np.minimum(radius / RINGS, math.floor(math.sqrt(0.5) / RINGS) - 1).astype(np.int64)
        # A half spectrum holds each frequency once except in the first column and, of an even width, the last.
        self._twice = np.full(radius.shape, 2.0)
        self._twice[:, 0] = 1.0
        if shape[1] % 2 == 0:
            self._twice[:, -1] = 1.0
        self._count = np.bincount(self._ring.ravel(), self._twice.ravel())
        self._radius = np.bincount(self._ring.ravel(), (self._twice * radius).ravel())
        self._error: Array = np.zeros(len(self._count))
        self._signal: Array = np.zeros(len(self._count))
        self._noise, self._captures = 0.0, 0

    def add(self, capture: CaptureResidual) -> None:
        """Add one capture to the sums."""
        pixels = capture.mask.sum()
        mean = float((capture.measured * capture.mask).sum() / pixels) if pixels else 0.0
        self._error = self._error + self._power(capture.residual)
        self._signal = self._signal + self._power((capture.measured - mean) * capture.mask)
        self._noise += float((self._window**2 * capture.mask * capture.noise).sum()) / self._norm
        self._captures += 1

    def _power(self, values: Array) -> Array:
        power = np.abs(np.fft.rfft2(values * self._window)) ** 2 * self._twice / self._norm
        return np.asarray(np.bincount(self._ring.ravel(), power.ravel()), dtype=np.float64)

    def rows(self) -> list[dict[str, float]]:
        """One row a ring.

        Keys `cycles_per_pixel` (the ring's mean), `error` (noise included), `noise` and `signal`, counts^2.
        """
        captures = max(self._captures, 1)
        return [
            {
                "cycles_per_pixel": float(self._radius[k] / self._count[k]),
                "error": float(self._error[k] / (self._count[k] * captures)),
                "noise": self._noise / captures,
                "signal": float(self._signal[k] / (self._count[k] * captures)),
            }
            for k in range(len(self._count))
            if self._count[k]
        ]


@dataclass
class BrightnessSums:
    """Error against the brightness that was predicted.

    Against the measured brightness even a perfect model would seem biased: pixels measured as bright are so
    partly by noise.

    Attributes
    ----------
    full_scale : float, counts
        Of the camera, above black.
    """

    full_scale: float
    _sums: Array = field(default_factory=lambda: np.zeros((5, FINE)))

    def add(self, capture: CaptureResidual) -> None:
        """Add one capture to the sums."""
        use = capture.mask > 0
        predicted, residual = capture.predicted[use], capture.residual[use]
        low, high = REACH
        place = (predicted / self.full_scale - low) / (high - low) * FINE
        index = np.clip(place, 0, FINE - 1).astype(np.int64)
        for row, values in zip(
            self._sums, (None, predicted, residual, residual**2, capture.noise[use]), strict=True
        ):
            row += np.bincount(index, values, minlength=FINE)

    def rows(self) -> list[dict[str, Any]]:
        """Steps of brightness, dark to bright, equal in the root of the counts, merged where pixels are few.

        Keys `counts` (mean prediction), `error` (mean squared residual above the noise, counts^2), `bias` (mean
        residual, measured less predicted, counts), `noise` (expected variance, counts^2) and `pixels`.
        """
        if not self._sums[0].any():
            return []
        low, high = REACH
        share = np.maximum((np.arange(FINE) + 0.5) / FINE * (high - low) + low, 0)
        top = share[np.flatnonzero(self._sums[0])[-1]]
        step = np.minimum(np.sqrt(share / top) * STEPS, STEPS - 1) if top else np.zeros(FINE)
        grouped = np.stack([np.bincount(step.astype(np.int64), row, minlength=STEPS) for row in self._sums])
        least = max(64.0, 5e-4 * grouped[0].sum())
        merged: list[Array] = []
        for column in grouped.T:
            if merged and merged[-1][0] < least:
                merged[-1] = merged[-1] + column
            else:
                merged.append(column)
        if len(merged) > 1 and merged[-1][0] < least:
            last = merged.pop()
            merged[-1] = merged[-1] + last
        return [
            {
                "counts": float(predicted / n),
                "error": float((squared - noise) / n),
                "bias": float(residual / n),
                "noise": float(noise / n),
                "pixels": int(n),
            }
            for n, predicted, residual, squared, noise in merged
            if n
        ]


def _hann(count: int) -> Array:
    return np.sin(math.pi * (np.arange(count) + 0.5) / count) ** 2
