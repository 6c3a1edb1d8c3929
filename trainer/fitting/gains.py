"""The gains of a model: camera counts a unit of irradiance and millisecond, by colour, fitted to captures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from trainer.captures.batches import load_batch
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.fitting.least_squares_gain import with_gain
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model


def with_gains(
    captures: CaptureSet, model: Model, rows: Sequence[Capture], done: Callable[[int], None] | None = None
) -> Model:
    """The model with the gains that it lacks fitted to captures, one in memory at a time.

    Parameters
    ----------
    rows : sequence of Capture
        What gains are fitted to; captures of colours that have a gain are left out.
    done : callable, optional
        Called with the number of captures that were used.
    """
    rows = [c for c in rows if c.channel not in model.gain]
    if not rows:
        return model
    channels = list(dict.fromkeys(c.channel for c in rows))
    found = with_gain(replace(model, gain={}), _Predictors(captures, model, rows, done))
    return replace(model, gain={**model.gain, **{c: found.gain[c] for c in channels}})


class _Predictors(Sequence[Predictor]):
    """Predictors of single captures, made when asked for."""

    def __init__(
        self, captures: CaptureSet, model: Model, rows: Sequence[Capture], done: Callable[[int], None] | None
    ) -> None:
        self.captures, self.model, self.rows, self.done = captures, model, rows, done

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        return Predictor(self.model, load_batch(self.captures, [self.rows[index]]))

    def __iter__(self) -> Iterator[Predictor]:
        for k in range(len(self)):
            yield self[k]
            if self.done:
                self.done(k + 1)
