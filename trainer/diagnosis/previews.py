"""What candidates would change in a picture, before any of them is added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trainer.captures.block_means import blocks
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.capture_errors import capture_errors
from trainer.diagnosis.ranking import RankedEffect
from trainer.fitting.predictor import evaluate_captures
from trainer.model.model import Model

MOST = 8  # candidates
LONGEST_PX = 160  # side of a picture
SHARE = 99.7  # per cent of the pixels that the colours hold
FEW = 5  # captures that are all predicted to find the worst one


@dataclass(frozen=True)
class CandidatePreview:
    """What a candidate would change in a picture.

    Attributes
    ----------
    effect : str
    capture : str
        The picture.
    missing : float32 array [h, w], counts
        Measured less predicted without the candidate; means of blocks.
    change : float32 array [h, w], counts
        Predicted with the candidate less predicted without it.
    scale : float, counts
        End of the colour scale of both.
    """

    effect: str
    capture: str
    missing: np.ndarray
    change: np.ndarray
    scale: float


def previews(captures: CaptureSet, model: Model, ranking: Sequence[RankedEffect]) -> list[CandidatePreview]:
    """What each candidate would change in a held-out capture: the worst one, where they are few."""
    if not ranking:
        return []
    roles = capture_roles(captures)
    row = roles.held_out[0]
    if len(roles.held_out) < FEW:
        row = max(roles.held_out, key=lambda c: _excess(captures, c, model))
    residual, _ = capture_errors(captures, row, model)
    factor = max(1, -(-max(residual.measured.shape) // LONGEST_PX))
    missing = blocks(np.where(residual.mask > 0, residual.residual, np.nan), factor).astype(np.float32)
    known = np.abs(missing[np.isfinite(missing)])
    scale = float(np.percentile(known, SHARE)) if known.size else 1.0
    found = []
    for one in ranking[:MOST]:
        there, _ = capture_errors(captures, row, one.model)
        change = blocks(there.predicted - residual.predicted, factor).astype(np.float32)
        found.append(CandidatePreview(one.effect.name, row.capture, missing, change, scale or 1.0))
    return found


def _excess(captures: CaptureSet, row: Capture, model: Model) -> float:
    return evaluate_captures(captures, [row], model).excess
