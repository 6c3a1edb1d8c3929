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
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import Capture, CaptureSet

PAST = 16  # panel pixels beyond the panel's border; the light path is computed for 24
FIT_PIXELS = 4 * 240 * 320  # about four small pictures hold a few dozen parameters to far below the noise


@dataclass(frozen=True)
class Batch:
    """Captures of one colour and one plane.

    gray [B, H, W] integers; signal [B, h, w] counts above black; weight [B, h, w] 1 where the pixel says something
    (not saturated), else 0; noise [B, h, w] expected variance of the camera's noise, counts^2; exposure [B], ms.
    """

    channel: str
    plane_mm: float
    ids: tuple[str, ...]
    gray: Tensor
    signal: Tensor
    weight: Tensor
    noise: Tensor
    exposure: Tensor


@dataclass(frozen=True)
class Split:
    """Captures for fitting and captures held out, as a partition of the set."""

    fitted: tuple[Capture, ...]
    held_out: tuple[Capture, ...]


def split(captures: CaptureSet) -> Split:
    """Every third pattern of each colour and plane is held out, from the second on (at least one).

    The choice depends on the order of the captures alone, so every command holds out the same ones. A colour and
    plane with a single pattern is held out only if all of them are like that, with its fit on the same capture's
    repeats; otherwise it is fitted.
    """
    fitted: list[Capture] = []
    held: list[Capture] = []
    for channel, plane in scenes(captures.captures):
        rows = [c for c in captures.captures if (c.channel, c.plane_mm) == (channel, plane)]
        patterns = list(dict.fromkeys(c.pattern for c in rows))
        out = set(patterns[1::3])
        for c in rows:
            (held if c.pattern in out else fitted).append(c)
    if not held:
        held = fitted[-1:]
    return Split(tuple(fitted), tuple(held))


def scenes(captures: Iterable[Capture]) -> list[tuple[str, float]]:
    """(channel, plane) pairs in order of appearance."""
    return list(dict.fromkeys((c.channel, c.plane_mm) for c in captures))


def sample(captures: Iterable[Capture], pixels: int, most: int) -> list[Capture]:
    """Different patterns for a fit, spread over colours and planes: at most `most`, at least one a scene."""
    by_scene: dict[tuple[str, float], dict[str, Capture]] = {}
    for c in captures:
        by_scene.setdefault((c.channel, c.plane_mm), {}).setdefault(c.pattern, c)
    columns = [list(patterns.values()) for patterns in by_scene.values()]
    # Patterns of one kind often follow each other: spread the choice over the whole list.
    columns = [[column[i] for i in _spread(len(column))] for column in columns]
    wanted = max(len(columns), min(most, FIT_PIXELS * max(1, len(columns)) // max(1, pixels)))
    chosen: list[Capture] = []
    depth = 0
    while len(chosen) < wanted and any(depth < len(column) for column in columns):
        chosen += [column[depth] for column in columns if depth < len(column)][: wanted - len(chosen)]
        depth += 1
    return chosen


def _spread(count: int) -> list[int]:
    """0 .. count-1 in an order whose every beginning is spread over the range (bit-reversed)."""
    bits = max(1, (count - 1).bit_length())
    order = [int(format(k, f"0{bits}b")[::-1], 2) for k in range(2**bits)]
    return [k for k in order if k < count]


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
