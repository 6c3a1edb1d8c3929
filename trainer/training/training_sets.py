"""The two parts of a capture set for a training: pairs that are learned from and pairs that are held out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from runtime.program.progress import Progress, no_progress, part_of
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import split
from trainer.fitting.gains import with_gains
from trainer.model.model import Model
from trainer.training.training_pairs import Pairs, pairs_of


@dataclass(frozen=True)
class TrainingSets:
    """Pairs of a capture set under a model.

    Attributes
    ----------
    fitted, held_out : Pairs
        Those that are learned from and those that are not.
    model : Model
        The model of the predictions, with its gains.
    about : dict
        Where they come from: keys `captures`, `captures_sha256`, `effects` and `channels`.
    """

    fitted: Pairs
    held_out: Pairs
    model: Model
    about: dict[str, Any]


def training_sets(
    captures: CaptureSet, model: Model, ideal: bool = False, progress: Progress | None = None
) -> TrainingSets:
    """The pairs of a capture set, split as every command splits it.

    Parameters
    ----------
    captures : CaptureSet
        Captures of the model's bench.
    model : Model
        Predicts them; its gains are fitted here.
    ideal : bool
        Leave the model's effects out.
    progress : callable or None
        Called with the share done.

    Raises
    ------
    InputError
        As from `pairs_of`.
    """
    parts = split(captures)
    if ideal:
        model = Model(captures.bench, method=model.method)
    model = with_gains(captures, replace(model, gain={}), parts.fitted)
    share = len(parts.fitted) / max(1, len(captures))

    say = progress or no_progress
    fitted = pairs_of(captures, parts.fitted, model, part_of(say, 0, share))
    held_out = pairs_of(captures, parts.held_out, model, part_of(say, share, 1))
    about = {
        "captures": captures.folder.name,
        "captures_sha256": captures.content_hash(),
        "effects": list(model.parts),
        "channels": [c.name for c in captures.bench.channels],
    }
    return TrainingSets(fitted, held_out, model, about)
