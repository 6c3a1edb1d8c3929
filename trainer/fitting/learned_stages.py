"""What has no name, learned at a stage of the light path: the stage's free form, fitted to captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from runtime.program.progress import Progress
from trainer.captures.batches import load, signal_variance
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import with_stopping
from trainer.device import array_of
from trainer.fitting.free_form_maps import FreeFormBatch, descend
from trainer.fitting.gains import with_gains
from trainer.fitting.learned_field import with_learned_field
from trainer.model.model import Model
from trainer.prediction.free_stages import learned_stage

CAPTURES = 12  # most that the gradient sees
ITERATIONS, ROUNDS = 6, 20  # between two checks of the captures that say when to stop; most checks


def with_learned_stage(
    captures: CaptureSet,
    rows: Sequence[Capture],
    model: Model,
    stage: str,
    progress: Progress | None = None,
) -> Model:
    """The model with the free form of a stage, learned from these captures; what was learned there is replaced.

    At the panel it is the panel's field. The last capture of each colour and plane says when to stop.

    Parameters
    ----------
    model : Model
        With fitted gains.
    stage : str
        One of STAGES.
    progress : callable, optional
        Called with the share that is done, 0 .. 1.
    """
    if stage == "panel":
        return with_learned_field(captures, rows, replace(model, panel_field=None), progress)
    model = replace(model, learned={s: maps for s, maps in model.learned.items() if s != stage})
    first, last = with_stopping(rows, CAPTURES)
    batches = load(captures, first)
    scale = signal_variance(batches)
    fitted, stopping = ([FreeFormBatch(model, b) for b in part] for part in (batches, load(captures, last)))
    free = learned_stage(model.bench, stage)
    found = descend(free, fitted, stopping, scale, ITERATIONS, ROUNDS, progress)
    maps = {name: array_of(tensor) for name, tensor in found.items()}
    return with_gains(captures, replace(model, gain={}, learned={**model.learned, stage: maps}), rows)
