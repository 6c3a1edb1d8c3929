"""A capture set as what a network learns from and what it is judged by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import split
from trainer.fitting.gains import with_gains
from trainer.model.model import Model
from trainer.training.pairs import Pairs, pairs_of

Progress = Callable[[float], None]


@dataclass(frozen=True)
class TrainingSets:
    """Pairs that are learned from and pairs that are held out, the model they are under, and where they come from."""

    fitted: Pairs
    held_out: Pairs
    model: Model
    about: dict[str, Any]


def training_sets(
    captures: CaptureSet, model: Model, ideal: bool = False, progress: Progress | None = None
) -> TrainingSets:
    """The pairs of a capture set, split as every command splits it.

    ideal : without the model's effects. Raises InputError as the capture set's reader does.
    """
    parts = split(captures)
    if ideal:
        model = Model(captures.bench, method=model.method)
    model = with_gains(captures, replace(model, gain={}), parts.fitted)
    share = len(parts.fitted) / max(1, len(captures))

    def told(begin: float, part: float) -> Progress | None:
        return None if progress is None else lambda done: progress(begin + part * done)

    fitted = pairs_of(captures, parts.fitted, model, told(0, share))
    held_out = pairs_of(captures, parts.held_out, model, told(share, 1 - share))
    about = {
        "captures": captures.folder.name,
        "captures_sha256": captures.content_hash(),
        "effects": list(model.parts),
        "channels": [c.name for c in captures.bench.channels],
    }
    return TrainingSets(fitted, held_out, model, about)
