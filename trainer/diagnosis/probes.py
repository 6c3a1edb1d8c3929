"""Free-form probes: the most general thing each stage could be doing, fitted alone.

The stage whose probe removes most of the held-out excess is where the missing physics is, also when no named
effect fits. A fitted probe is a picture that shows a fringe, a speck or a stripe.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from runtime.excess import PredictionErrors, RemovedExcess, joined, removed_excess
from trainer.captures.batches import load, load_batch, signal_variance
from trainer.captures.capture_set import chosen, opened
from trainer.captures.held_out import with_stopping
from trainer.fitting.free_form_maps import FreeFormBatch, descend
from trainer.model.model import Model
from trainer.prediction.free_stages import FREE_STAGES, MapPicture

ROUND = 2  # iterations between two checks of the captures that say when to stop
ROUNDS = {"drive": 7, "panel": 12, "pupil": 10, "sensor": 12}
CAPTURES = {"drive": 4, "panel": 8, "pupil": 6, "sensor": 8}  # most that the gradient sees


@dataclass(frozen=True)
class ProbeFit:
    """A fitted probe.

    Attributes
    ----------
    stage : str
    held_out : PredictionErrors
        Errors with the probe on the held-out captures.
    pictures : tuple of MapPicture
        Its maps.
    """

    stage: str
    held_out: PredictionErrors
    pictures: tuple[MapPicture, ...]


@dataclass(frozen=True)
class ProbeResult:
    """A probe judged against the model without it.

    Attributes
    ----------
    removed : RemovedExcess
        Held-out excess that the probe removes.
    excess_after : float
        Held-out excess with the probe.
    """

    stage: str
    removed: RemovedExcess
    excess_after: float
    pictures: tuple[MapPicture, ...]

    @classmethod
    def judged(cls, found: ProbeFit, before: PredictionErrors) -> ProbeResult:
        """How much held-out excess the probe removes."""
        return cls(found.stage, removed_excess(before, found.held_out), found.held_out.excess, found.pictures)

    def as_json(self) -> dict[str, Any]:
        """A row of the key `stages` of `diagnose --json`: `stage`, `excess_removed`, `excess_after` and `ci95`."""
        low, high = self.removed.interval()
        return {
            "stage": self.stage,
            "excess_removed": self.removed.value,
            "excess_after": self.excess_after,
            "ci95": [low, high],
        }


def probe(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, stage: str
) -> ProbeFit:
    """Fit one stage's probe on some captures and judge it on others.

    Parameters
    ----------
    folder : Path
        Of the capture set.
    ids, held_ids : tuple of str
        Captures to fit, and captures to judge by.
    model : Model
        With fitted gains.
    """
    captures = opened(folder)
    rows = chosen(captures, ids)
    first, last = with_stopping(rows, CAPTURES[stage])
    batches = load(captures, first)
    free = FREE_STAGES[stage](model.bench)
    scale = signal_variance(batches)
    # One capture a colour and plane is kept from the gradient and says when to stop.
    fitted, stopping = ([FreeFormBatch(model, b) for b in part] for part in (batches, load(captures, last)))
    found = descend(free, fitted, stopping, scale, ROUND, ROUNDS[stage])
    with torch.no_grad():
        parts = []
        for row in chosen(captures, held_ids):
            held = FreeFormBatch(model, load_batch(captures, [row]))
            parts.append(held.batch.errors(held.predict(free, found, 0)))
        return ProbeFit(stage, joined(parts), tuple(free.pictures(found)))
