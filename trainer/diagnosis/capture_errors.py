"""One capture, measured and predicted, and where the model fails on it: what maps of a whole set are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from runtime.excess import PredictionErrors, joined
from trainer.captures.batches import Batch, load_batch
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import split
from trainer.diagnosis.error_budget import network_changes, with_change
from trainer.diagnosis.localise import CaptureResidual, FieldSums, FrequencySums, residual_of
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model
from trainer.networks.approximator import Approximator
from trainer.training.training_pairs import stacked

STEPS = 16  # of brightness, equal in the root of the counts


@dataclass(frozen=True)
class CaptureErrors:
    """Where a model fails on one capture.

    Attributes
    ----------
    capture, channel : str
    plane_mm : float, mm
    time_s : float, s
    errors : PredictionErrors
    gain : float or None
        Least-squares factor from prediction to measurement.
    tile_px : int, pixels
        Side of a tile of `field`.
    field : float64 array [rows, columns], counts^2
        Mean squared error above the noise in each tile; NaN where a tile is saturated.
    frequency : float64 array [4, rings]
        Cycles/pixel; power of the error, of the expected noise and of the signal, counts^2.
    brightness : float64 array [4, STEPS]
        Pixels, and sums of squared residual above the noise (counts^2), residual (counts) and noise (counts^2),
        by steps of the predicted counts.
    edges : float64 array [STEPS + 1], counts
        Of these steps.
    """

    capture: str
    channel: str
    plane_mm: float
    time_s: float
    errors: PredictionErrors
    gain: float | None
    tile_px: int
    field: np.ndarray
    frequency: np.ndarray
    brightness: np.ndarray
    edges: np.ndarray

    @property
    def has_contrast(self) -> bool:
        """Whether the capture has any signal to compare with."""
        return bool(self.errors.variance.sum() > 0)


def capture_errors(
    captures: CaptureSet, capture: Capture, model: Model, network: Approximator | None = None
) -> tuple[CaptureResidual, CaptureErrors | None]:
    """A capture and its prediction, and where they differ; None for the latter where every pixel is saturated.

    Parameters
    ----------
    model : Model
        With fitted gains.
    network : Approximator, optional
        Trained on what the model leaves; its part is in the prediction.
    """
    batch = load_batch(captures, [capture])
    with torch.no_grad():
        if network is None:
            prediction = Predictor(model, batch).predict(model)
        else:
            prediction = _with_network(captures, capture, batch, model, network)
    residual = residual_of(batch, prediction)
    if not bool(batch.mask.any()):
        return residual, None
    field, frequency = FieldSums(captures.bench.camera.shape), FrequencySums(captures.bench.camera.shape)
    field.add(residual)
    frequency.add(residual)
    tiles = [[np.nan if v is None else v for v in row] for row in field.excess(1.0)]
    rings = [[row[k] for row in frequency.rows()] for k in ("cycles_per_pixel", "error", "noise", "signal")]
    edges = captures.bench.camera.full_scale * (np.arange(STEPS + 1) / STEPS) ** 2
    found = CaptureErrors(
        capture.capture,
        capture.channel,
        capture.plane_mm,
        capture.time_s,
        batch.errors(prediction),
        residual.gain,
        field.tile,
        np.array(tiles),
        np.array(rings),
        _by_brightness(residual, edges),
        edges,
    )
    return residual, found


def _with_network(
    captures: CaptureSet, capture: Capture, batch: Batch, model: Model, network: Approximator
) -> Tensor:
    """Counts that model and network expect; the network sees the other colours of the same picture, too."""
    divided = split(captures)
    rows = divided.held_out if capture in divided.held_out else divided.fitted
    stack = next(s for s in stacked(captures, rows) if capture in s)
    batches = [None if c is None else batch if c == capture else load_batch(captures, [c]) for c in stack]
    change = network_changes(model, network, batches)[stack.index(capture)]
    return with_change(model, batch, change)[1]


def _by_brightness(residual: CaptureResidual, edges: np.ndarray) -> np.ndarray:
    use = residual.mask > 0
    predicted, apart, noise = residual.predicted[use], residual.residual[use], residual.noise[use]
    step = np.clip(np.searchsorted(edges, predicted, side="right") - 1, 0, STEPS - 1)
    values = (None, apart**2 - noise, apart, noise)
    return np.stack([np.bincount(step, v, minlength=STEPS) for v in values]).astype(np.float64)


@dataclass(frozen=True)
class SetErrors:
    """Where a model fails on several captures together.

    Attributes
    ----------
    captures : tuple of CaptureErrors
        Those with contrast.
    """

    captures: tuple[CaptureErrors, ...]

    @classmethod
    def of(cls, found: Sequence[CaptureErrors]) -> SetErrors | None:
        """Of the captures with contrast; None where there is none."""
        used = tuple(one for one in found if one.has_contrast)
        return cls(used) if used else None

    @property
    def errors(self) -> PredictionErrors:
        """Of all captures."""
        return joined([one.errors for one in self.captures])

    @property
    def variance(self) -> float:
        """Of the measured signal, counts^2 a pixel."""
        errors = self.errors
        return float(errors.variance.sum() / errors.pixels.sum())

    @property
    def field(self) -> np.ndarray:
        """Excess of each tile [rows, columns]; NaN where a tile is saturated in every capture."""
        stack = np.stack([one.field for one in self.captures])
        count = np.isfinite(stack).sum(0)
        return np.where(count > 0, np.nansum(stack, 0) / np.maximum(count, 1), np.nan) / self.variance

    @property
    def frequency(self) -> np.ndarray:
        """As of `CaptureErrors`, mean over the captures."""
        return np.asarray(np.mean([one.frequency for one in self.captures], 0))

    @property
    def brightness(self) -> np.ndarray:
        """[5, steps]: counts in the middle; rms error above noise, bias, and noise (counts); pixels. NaN: no pixel."""
        pixels, above, bias, noise = np.sum([one.brightness for one in self.captures], 0)
        edges = self.captures[0].edges
        some = np.where(pixels >= max(16.0, 1e-4 * pixels.sum()), pixels, np.nan)
        return np.stack(
            [
                (edges[1:] + edges[:-1]) / 2,
                np.sqrt(np.maximum(above / some, 0)),
                bias / some,
                np.sqrt(noise / some),
                pixels,
            ]
        )

    def time(self) -> list[dict[str, Any]]:
        """One row a capture in the order of time: keys `capture`, `channel`, `time_s`, `gain` and `excess`."""
        rows = [
            {
                "capture": one.capture,
                "channel": one.channel,
                "time_s": one.time_s,
                "gain": one.gain,
                "excess": one.errors.excess,
            }
            for one in self.captures
        ]
        return sorted(rows, key=lambda row: row["time_s"])

    def where(self) -> dict[str, Any]:
        """The rows under `where` of `compare --json`."""
        keys = ("cycles_per_pixel", "error", "noise", "signal")
        counts, error, bias, noise, pixels = self.brightness
        return {
            "field": [[float(v) if np.isfinite(v) else None for v in row] for row in self.field],
            "tile_px": self.captures[0].tile_px,
            "frequency": [dict(zip(keys, map(float, ring), strict=True)) for ring in self.frequency.T],
            "brightness": [
                {
                    "counts": float(counts[k]),
                    "error": float(error[k] ** 2),
                    "bias": float(bias[k]),
                    "noise": float(noise[k] ** 2),
                    "pixels": float(pixels[k]),
                }
                for k in np.flatnonzero(np.isfinite(error))
            ],
            "time": self.time(),
        }

    def worst_at(self, row: int, column: int) -> list[tuple[str, float]]:
        """Captures by their excess in a tile, worst first."""
        return self._ordered([one.field[row, column] / self.variance for one in self.captures])

    def worst_in_ring(self, ring: int) -> list[tuple[str, float]]:
        """Captures by the power of their error above the noise in a ring of frequencies, counts^2, worst first."""
        return self._ordered([one.frequency[1, ring] - one.frequency[2, ring] for one in self.captures])

    def worst_in_step(self, step: int) -> list[tuple[str, float]]:
        """Captures by their rms error above the noise in a step of brightness, counts, worst first."""
        rows = [one.brightness[:, step] for one in self.captures]
        return self._ordered([np.sqrt(max(r[1] / r[0], 0)) if r[0] else np.nan for r in rows])

    def _ordered(self, values: Sequence[float]) -> list[tuple[str, float]]:
        named = [(one.capture, float(v)) for one, v in zip(self.captures, values, strict=True)]
        return sorted((pair for pair in named if np.isfinite(pair[1])), key=lambda pair: -pair[1])
