"""Captures as tensors, and which of them a fit may see.

A fit sees some patterns; every number that is reported comes from others. Repeats of one pattern never stand on
both sides.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.excess import PredictionErrors, prediction_errors
from runtime.lightpath.grid import MARGIN
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import scenes

PAST = (
    MARGIN - 8
)  # panel pixels beyond the panel's border that are compared: all that splines reach is computed


@dataclass(frozen=True)
class Batch:
    """Captures of one colour and one plane.

    gray [B, H, W] integers; signal [B, h, w] counts above black; mask [B, h, w] 1 where the pixel says something
    (not saturated), else 0; noise [B, h, w] expected variance of the camera's noise, counts^2; exposure [B], ms.
    """

    channel: str
    plane_mm: float
    ids: tuple[str, ...]
    gray: Tensor
    signal: Tensor
    mask: Tensor
    noise: Tensor
    exposure: Tensor

    def errors(self, prediction: Tensor) -> PredictionErrors:
        """Errors of predicted counts [B, h, w]."""
        return prediction_errors(self.ids, self.signal, prediction, self.noise, self.mask)


def load(captures: CaptureSet, chosen: Iterable[Capture], dtype: torch.dtype = torch.float32) -> list[Batch]:
    """The chosen captures as one batch a colour and plane. Raises InputError as the capture set's reader does."""
    chosen = list(chosen)
    return [
        load_batch(captures, [c for c in chosen if (c.channel, c.plane_mm) == scene], dtype)
        for scene in scenes(chosen)
    ]


@lru_cache(maxsize=4)
def in_view(bench: Bench) -> np.ndarray | None:
    """Which camera pixels look at the panel, or not far past it, bool [h, w]; None where all of them do.

    Farther out nothing is predicted: most cameras see more than the panel's picture. Raises InputError where the
    homography puts no pixel there.
    """
    if bench.camera.registered:
        return None
    y, x = bench.camera.looks_at()
    height, width = bench.panel.shape
    seen = (y >= -PAST) & (y <= height - 1 + PAST) & (x >= -PAST) & (x <= width - 1 + PAST)
    if not seen.any():
        raise InputError(
            "camera.homography puts no pixel of the camera on the panel: give the matrix from camera pixels "
            "(x, y, 1) to panel pixels, not its inverse, or find it with: hololoop-trainer register bench.toml"
        )
    return seen


def load_batch(captures: CaptureSet, chosen: list[Capture], dtype: torch.dtype = torch.float32) -> Batch:
    """Captures of one colour and plane as a batch."""
    view = in_view(captures.bench)
    signals, weights, grays = [], [], []
    for c in chosen:
        signal, valid = captures.signal(c)
        signals.append(signal)
        weights.append(valid if view is None else valid & view)
        grays.append(captures.gray(c).astype(np.int32))
    signal = np.stack(signals)
    return Batch(
        chosen[0].channel,
        chosen[0].plane_mm,
        tuple(c.capture for c in chosen),
        torch.as_tensor(np.stack(grays)),
        torch.as_tensor(signal, dtype=dtype),
        torch.as_tensor(np.stack(weights), dtype=dtype),
        torch.as_tensor(captures.noise_variance(signal), dtype=dtype),
        torch.tensor([c.exposure_ms for c in chosen], dtype=dtype),
    )
