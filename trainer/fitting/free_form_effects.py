"""Maps of effects that go on in free form, as bicubic splines, where their polynomials end.

The nodes are fitted by L-BFGS through the light path's adjoint, from coarse to fine, in turn with all the model's
other numbers. Captures that the gradient does not use say when to stop and how many nodes the data can tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from runtime.excess import joined
from runtime.lightpath.spline_maps import nodes_over, on_other_nodes
from runtime.program.progress import Progress, no_progress
from trainer.captures.batches import Batch
from trainer.effects.free_form import FreeForm, grid_of, surface_over
from trainer.fitting.free_form_maps import FreeFormBatch, descend
from trainer.fitting.gauss_newton import fit
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model
from trainer.prediction.free_stages import FreeFormStage, Tensors
from trainer.prediction.scene import Stages

PARTS = (18, 36, 72)  # of the grid's shorter side between nodes, coarse to fine
LEAST_SPACING = 6  # samples between nodes: finer than that is no smooth map
ITERATIONS, ROUNDS = 6, 5  # between two checks of the captures that say when to stop; most checks
FIRST_GAIN = 0.25  # share of the error that the coarsest map must remove for the polynomials to have ended
FINER_GAIN = 0.05  # share that more nodes must remove to be kept
REFIT_ITERATIONS = 3


def can_go_on(model: Model) -> tuple[str, ...]:
    """Names of a model's effects whose maps may go on in free form."""
    return tuple(p.effect.name for p in model.present if p.effect.free_form is not None)


def with_free_form(
    model: Model,
    name: str,
    fitted: Sequence[Batch],
    stopping: Sequence[Batch],
    progress: Progress | None = None,
) -> Model | None:
    """The model with an effect's map gone on in free form, and everything else refitted with it.

    Parameters
    ----------
    model : Model
        With fitted gains.
    name : str
        Of an effect with a free form.
    fitted, stopping : sequence of Batch
        Captures for the gradient, and other captures that say when to stop and how fine the map is.
    progress : callable, optional
        Called with the share that is done.

    Returns
    -------
    Model or None
        None where a coarse map does not remove a quarter of the error: the polynomials have not ended.
    """
    report = progress or no_progress
    best, least = model, _excess(model, stopping)
    grid = _grid(model, name, fitted[0])
    spacings = sorted({max(min(grid) / parts, LEAST_SPACING) for parts in PARTS}, reverse=True)
    for level, spacing in enumerate(spacings):
        report(level / len(spacings))
        trial = _descended(best, name, spacing, fitted, stopping)
        trial = fit(trial, trial.names, fitted, iterations=REFIT_ITERATIONS).model
        excess = _excess(trial, stopping)
        if least - excess < (FIRST_GAIN if level == 0 else FINER_GAIN) * abs(least):
            break
        best, least = trial, excess
    return None if best is model else best


def refined(model: Model, fitted: Sequence[Batch], stopping: Sequence[Batch]) -> Model:
    """The model with its free-form maps fitted again, each on the nodes that it has."""
    for present in model.present:
        if present.nodes is not None:
            model = _descended(model, present.effect.name, None, fitted, stopping)
    return model


def _descended(
    model: Model, name: str, spacing: float | None, fitted: Sequence[Batch], stopping: Sequence[Batch]
) -> Model:
    """The model with one effect's nodes fitted, on a grid of some spacing or on the nodes that they have."""
    present = model.instance(name)
    form = present.effect.free_form
    assert form is not None
    stage = present.effect.stage
    if spacing is not None:
        grid = _grid(model, name, fitted[0])
        shape = nodes_over(grid, spacing)
        before = np.zeros(shape) if present.nodes is None else on_other_nodes(present.nodes, shape, grid)
        present = replace(present, nodes=before)
        model = model.having(present)
    assert present.nodes is not None
    free = _stage_of(form, stage, present.nodes.shape)
    parts = [[FreeFormBatch(model, b) for b in batches] for batches in (fitted, stopping)]
    scale = sum(float(b.errors(torch.zeros_like(b.signal)).variance.sum()) for b in fitted)
    found = descend(free, parts[0], parts[1], scale, ITERATIONS, ROUNDS)
    return model.having(replace(present, nodes=present.nodes + found["nodes"].double().numpy()))


def _grid(model: Model, name: str, batch: Batch) -> tuple[int, int]:
    """Samples of the grid that an effect's map lies on."""
    stages = Predictor(model, batch).stages(model)
    return grid_of(getattr(stages, model.instance(name).effect.stage))


def _stage_of(form: FreeForm, stage: str, nodes: tuple[int, ...]) -> FreeFormStage:
    def apply(stages: Stages, maps: Tensors) -> Stages:
        one = getattr(stages, stage)
        return replace(stages, **{stage: form.apply(one, surface_over(one, maps["nodes"]))})

    # A step of the optimiser's variables is one of many nodes at once.
    unit = 5 * form.scale * float(np.sqrt(np.prod(nodes)))
    return FreeFormStage(stage, {"nodes": (tuple(nodes), unit)}, apply, lambda maps: [])


def _excess(model: Model, batches: Sequence[Batch]) -> float:
    with torch.no_grad():
        return joined([b.errors(Predictor(model, b).predict(model)) for b in batches]).excess
