"""The panel's field, learned from captures: what acts on the wave at the panel and no effect describes.

The most probable maps given the captures: squared errors in units of the noise's variance, and a Gaussian prior a
pixel around "absent", which decides where the captures do not. The descent is stopped by captures that the gradient
does not use.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from runtime.excess import PredictionErrors
from runtime.program.progress import Progress, no_progress, part_of
from trainer.captures.batches import Batch, load
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import FIT_CAPTURES, sample, split
from trainer.device import array_of
from trainer.fitting.free_form_maps import FreeFormBatch, descend
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.predictor import evaluate_captures
from trainer.model.history import recorded
from trainer.model.model import Model
from trainer.prediction.free_stages import FreeFormStage, Tensors
from trainer.prediction.panel_field import NAME, UNITS, combined, with_field
from trainer.prediction.scene import Stages

SPREAD = {
    "log_amplitude": 0.2,
    "phase": 0.2,
    "added_real": 0.03,
    "added_imaginary": 0.03,
}  # of the prior, UNITS
FLOOR = 0.1  # of the mean noise variance, added to each pixel's, which limits the weight of dark pixels
ITERATIONS, ROUNDS = 10, 20  # between two checks of the captures that say when to stop; most checks
REFITS = 8  # iterations of the effects' fit together with the field
REFINED, REFINED_ROUNDS = 0.1, 10  # share of the prior's spread, and rounds, for the field of one picture


@dataclass(frozen=True)
class PanelFieldFit:
    """A model with a learned panel field, and its held-out errors.

    Attributes
    ----------
    model : Model
        With the field.
    before, after : PredictionErrors
        Without and with the field.
    is_held_out : bool
        False where there is only one pattern, so that what is judged is what was fitted.
    """

    model: Model
    before: PredictionErrors
    after: PredictionErrors
    is_held_out: bool = True

    def as_json(self) -> dict[str, Any]:
        """Keys `before` and `after` (errors), `held_out`, and `maps`: `lowest` and `highest` of each over the panel."""
        assert self.model.panel_field is not None
        maps = {
            f"{name}_{unit}" if unit != "1" else name: {
                "lowest": float(self.model.panel_field[name].min()),
                "highest": float(self.model.panel_field[name].max()),
            }
            for name, unit in UNITS.items()
        }
        return {
            "before": self.before.as_json(),
            "after": self.after.as_json(),
            "maps": maps,
            "held_out": self.is_held_out,
        }


def learn_field(captures: CaptureSet, model: Model, progress: Progress | None = None) -> PanelFieldFit:
    """Learn a model's panel field from the captures that fits may use, and judge it on the others.

    A field that the model already has is replaced.

    Parameters
    ----------
    progress : callable, optional
        Called with the share that is done, 0 .. 1.

    Raises
    ------
    InputError
        As the capture set's reader does.
    """
    divided = split(captures)
    model = with_gains(captures, replace(model, gain={}, panel_field=None), divided.fitted)
    before = evaluate_captures(captures, divided.held_out, model)
    learned = with_learned_field(captures, divided.fitted, model, progress)
    after = evaluate_captures(captures, divided.held_out, learned)
    return PanelFieldFit(recorded(learned, NAME, after), before, after, divided.is_held_out)


def with_learned_field(
    captures: CaptureSet,
    rows: Sequence[Capture],
    model: Model,
    progress: Progress | None = None,
) -> Model:
    """The model with a field learned from these captures.

    The model's effects were fitted without the field, so they are fitted once more with it, and the field is learned
    again with them. The last capture of each colour and plane says when to stop, and is not learned from unless it is
    the only one.

    Parameters
    ----------
    model : Model
        With fitted gains.
    progress : callable, optional
        Called with the share that is done, 0 .. 1.
    """
    report = progress or no_progress
    last = list({(c.channel, c.plane_mm): c for c in rows}.values())
    first = [c for c in rows if c not in last] or list(rows)

    def learned(begin: Model, share: float) -> Model:
        fitted, stopping = (_in_noise_units(begin, load(captures, part)) for part in (first, last))
        found = _descend(begin, SPREAD, fitted, stopping, ROUNDS, part_of(report, share, share + 0.5))
        return replace(begin, panel_field=found)

    once = learned(model, 0.0)
    if model.present:
        pixels = captures.bench.camera.height * captures.bench.camera.width
        few = load(captures, sample(rows, pixels, FIT_CAPTURES))
        again = fit(once, once.names, few, iterations=REFITS).model
        once = learned(replace(again, panel_field=None), 0.5)
    return with_gains(captures, replace(once, gain={}), rows)


def with_refined_field(model: Model, sets: Sequence[tuple[CaptureSet, Sequence[Capture]]]) -> Model:
    """The model with its field refined for the few pictures of these captures.

    Dust and other structure finer than the pixels acts differently on each picture; near one picture's patterns a
    slightly different field describes it.

    References
    ----------
    Chakravarthula et al. 2020, section 7, here on the wave at the panel.
    """
    assert model.panel_field is not None
    narrow = {name: REFINED * spread for name, spread in SPREAD.items()}
    batches = []
    for captures, rows in sets:
        batches += _in_noise_units(with_gains(captures, replace(model, gain={}), rows), load(captures, rows))
    found = _descend(model, narrow, batches, batches, REFINED_ROUNDS)
    return replace(model, panel_field=combined(model.panel_field, found))


def _descend(
    model: Model,
    spread: Mapping[str, float],
    fitted: Sequence[FreeFormBatch],
    stopping: Sequence[FreeFormBatch],
    rounds: int,
    progress: Progress | None = None,
) -> dict[str, np.ndarray]:
    """Most probable maps beyond the model; a unit of the optimiser's variables is a large change of the panel."""
    height, width = model.bench.panel.shape
    unit = 5 * math.sqrt(height * width)
    shapes: dict[str, tuple[tuple[int, ...], float]] = {n: ((height, width), unit * spread[n]) for n in UNITS}

    def apply(stages: Stages, maps: Tensors) -> Stages:
        return replace(stages, panel=with_field(stages.panel, maps))

    free = FreeFormStage("panel", shapes, apply, lambda maps: [], spread)
    pixels = sum(float((b.batch.mask > 0).sum()) for b in fitted)
    found = descend(free, fitted, stopping, max(pixels, 1.0), ITERATIONS, rounds, progress)
    return {name: array_of(surface) for name, surface in found.items()}


def _in_noise_units(model: Model, batches: Sequence[Batch]) -> list[FreeFormBatch]:
    """Batches whose squared errors are multiples of the noise's variance."""
    found = []
    for batch in batches:
        noise = batch.noise + FLOOR * batch.noise.mean()
        found.append(FreeFormBatch(model, batch, 1 / noise))
    return found
