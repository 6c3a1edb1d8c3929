"""Captures as tensors: one batch for each colour and plane."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.excess import PredictionErrors, prediction_errors
from runtime.lightpath.grid import MARGIN
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture, Moment, ids_of
from trainer.captures.held_out import scenes
from trainer.captures.smoothing import smoothed
from trainer.device import array_of

# Panel pixels beyond the panel's border that are compared. The splines' reach beyond them is computed too.
PAST_BORDER = MARGIN - 8
EARLIER = 2  # patterns before a capture's own that a slow panel may still show


@dataclass(frozen=True)
class Batch:
    """Captures of one colour and one plane.

    Attributes
    ----------
    channel : str
    plane_mm : float, mm
    ids : tuple of str
        The captures'.
    gray : int Tensor [B, H, W]
        Gray levels sent to the panel.
    signal : Tensor [B, h, w], counts above black
    mask : Tensor [B, h, w]
        1 where the pixel can be used (not saturated, and in view of the panel), else 0.
    noise : Tensor [B, h, w], counts^2
        Expected variance of the camera's noise.
    exposure : Tensor [B], ms
    usual_exposure : float, ms
        The usual one of the colour, at which added light is counted.
    shown_before : callable
        Gives the patterns shown before each capture, the last one first: int Tensor [B, EARLIER, H, W]. They are read
        when first asked for.
    smoothing_px : float
        Standard deviation of the Gaussian that `signal` was smoothed with, and predictions must be; 0 for none.
    seen : Tensor [B, h, w] or None
        The mask before smoothing.
    moments : tuple of Moment
        When each capture was taken; () where they were not.
    """

    channel: str
    plane_mm: float
    ids: tuple[str, ...]
    gray: Tensor
    signal: Tensor
    mask: Tensor
    noise: Tensor
    exposure: Tensor
    usual_exposure: float
    shown_before: Callable[[], Tensor]
    smoothing_px: float = 0.0
    seen: Tensor | None = None
    moments: tuple[Moment, ...] = ()

    def smoothed(self, sigma_px: float) -> Batch:
        """The batch with smoothed pictures: what is left of speckle that is a pixel off are spots, edges, brightness.

        Parameters
        ----------
        sigma_px : float, camera pixels
            Standard deviation of the Gaussian; pixels that cannot be used count as dark in picture and prediction.
        """
        return replace(
            self,
            signal=smoothed(self.mask * self.signal, sigma_px),
            mask=torch.ones_like(self.mask),
            noise=smoothed(self.mask * self.noise, sigma_px) / max(1.0, 4 * math.pi * sigma_px**2),
            smoothing_px=sigma_px,
            seen=self.mask,
        )

    def only(self, places: list[int]) -> Batch:
        """The batch's captures at these places alone."""
        tensors = {k: getattr(self, k)[places] for k in ("gray", "signal", "mask", "noise", "exposure")}
        seen = None if self.seen is None else self.seen[places]
        ids = tuple(self.ids[k] for k in places)
        moments = tuple(self.moments[k] for k in places) if self.moments else ()
        return replace(
            self,
            ids=ids,
            shown_before=lambda: self.shown_before()[places],
            seen=seen,
            moments=moments,
            **tensors,
        )

    def as_compared(self, counts: Tensor) -> Tensor:
        """Predicted counts [B, h, w] as `signal` is: smoothed where it is smoothed."""
        return counts if self.seen is None else smoothed(self.seen * counts, self.smoothing_px)

    def errors(self, prediction: Tensor) -> PredictionErrors:
        """Errors of predicted counts above black, Tensor [B, h, w]."""
        arrays = (array_of(t) for t in (self.signal, prediction, self.noise, self.mask))
        return prediction_errors(self.ids, *arrays)


def load(captures: CaptureSet, chosen: Iterable[Capture], dtype: torch.dtype = torch.float32) -> list[Batch]:
    """The chosen captures as one batch for each colour and plane.

    Raises
    ------
    InputError
        As the capture set's reader does.
    """
    chosen = list(chosen)
    return [
        load_batch(captures, [c for c in chosen if (c.channel, c.plane_mm) == scene], dtype)
        for scene in scenes(chosen)
    ]


def signal_variance(batches: Iterable[Batch]) -> float:
    """Sum of squares of the signals about their means, counts squared: what an excess is a share of."""
    return sum(float(b.errors(torch.zeros_like(b.signal)).variance.sum()) for b in batches)


@lru_cache(maxsize=4)
def in_view(bench: Bench) -> np.ndarray | None:
    """Which camera pixels look at the panel, or at most PAST_BORDER panel pixels beyond it.

    Farther out nothing is predicted: most cameras see more than the panel's picture.

    Returns
    -------
    bool array [h, w] or None
        None where all of them do.

    Raises
    ------
    InputError
        Where the homography puts no pixel there.
    """
    if bench.camera.registered:
        return None
    y, x = bench.camera.looks_at()
    height, width = bench.panel.shape
    inside = (
        (y >= -PAST_BORDER)
        & (y <= height - 1 + PAST_BORDER)
        & (x >= -PAST_BORDER)
        & (x <= width - 1 + PAST_BORDER)
    )
    if not inside.any():
        raise InputError(
            "camera.homography puts no pixel of the camera on the panel: give the matrix from camera pixels "
            "(x, y, 1) to panel pixels, not its inverse, or find it with: hololoop-trainer register bench.toml"
        )
    return inside


def load_batch(captures: CaptureSet, chosen: list[Capture], dtype: torch.dtype = torch.float32) -> Batch:
    """Captures of one colour and plane as a batch."""
    view = in_view(captures.bench)
    signals, weights, variances, grays = [], [], [], []
    for c in chosen:
        measured = captures.measured(c)
        signals.append(measured.signal)
        weights.append(measured.valid if view is None else measured.valid & view)
        variances.append(measured.variance)
        grays.append(captures.gray(c).astype(np.int32))
    return Batch(
        chosen[0].channel,
        chosen[0].plane_mm,
        ids_of(chosen),
        torch.as_tensor(np.stack(grays)),
        torch.as_tensor(np.stack(signals), dtype=dtype),
        torch.as_tensor(np.stack(weights), dtype=dtype),
        torch.as_tensor(np.stack(variances), dtype=dtype),
        torch.tensor([c.exposure_ms for c in chosen], dtype=dtype),
        captures.usual_exposure_ms(chosen[0].channel),
        cache(lambda: _shown_before(captures, chosen)),
        moments=moments_of(captures, chosen),
    )


def moments_of(captures: CaptureSet, chosen: Iterable[Capture]) -> tuple[Moment, ...]:
    """When captures were taken."""
    order = {c.capture: k for k, c in enumerate(captures.captures)}
    return tuple(Moment(float(order[c.capture]), c.time_s) for c in chosen)


def _shown_before(captures: CaptureSet, chosen: list[Capture]) -> Tensor:
    """Patterns before each capture, in the order in which they were taken; the first one's own before it.

    A bracket is one capture, so the pattern before it is that of the capture or bracket before.
    """
    order = {c.capture: k for k, c in enumerate(captures.captures)}
    earlier = []
    for c in chosen:
        places = [max(order[c.capture] - back, 0) for back in range(1, EARLIER + 1)]
        earlier.append(np.stack([captures.gray(captures.captures[k]).astype(np.int32) for k in places]))
    return torch.as_tensor(np.stack(earlier))
