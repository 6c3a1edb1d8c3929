"""Captures that say most of what a model lacks: those that it explains worst."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from trainer.captures.batches import load_batch
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import CaptureRoles
from trainer.fitting.predictor import Predictor
from trainer.fitting.side_by_side import side_by_side
from trainer.model.model import Model


def telling_captures(captures: CaptureSet, rows: Sequence[Capture], model: Model) -> list[Capture]:
    """The capture of each colour and plane of which a model leaves most unexplained, in counts."""
    ordered = _by_unexplained(captures, rows, model)
    return list({(c.channel, c.plane_mm): c for c in ordered}.values())


def most_telling_capture(captures: CaptureSet, rows: Sequence[Capture], model: Model) -> Capture:
    """The capture of which a model leaves most unexplained, in counts."""
    return _by_unexplained(captures, rows, model)[-1]


@torch.no_grad()
def _by_unexplained(captures: CaptureSet, rows: Sequence[Capture], model: Model) -> list[Capture]:
    """Captures, the one of which a model leaves least unexplained first."""

    def left(row: Capture) -> float:
        batch = load_batch(captures, [row])
        errors = batch.errors(Predictor(model, batch).predict(model))
        return float(errors.squared.sum() - errors.noise.sum())

    panel = captures.bench.panel
    unexplained = side_by_side(left, rows, panel.width * panel.height)
    return [row for _, row in sorted(zip(unexplained, rows, strict=True), key=lambda one: one[0])]


def screened_captures(roles: CaptureRoles, model: Model) -> Sequence[Capture]:
    """Captures to screen a model's candidates on: of what it explains to the noise, no candidate removes anything."""
    return telling_captures(roles.captures, roles.screenable, model) if model.present else roles.screened
