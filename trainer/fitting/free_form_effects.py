"""Maps and curves of effects that go on in free form, as cubic splines, where their polynomials end.

The nodes are fitted by L-BFGS through the light path's adjoint, from coarse to fine, in turn with all the model's
other numbers. Captures that the gradient does not use say when to stop and how many nodes the data can tell.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from runtime.lightpath.spline_maps import nodes_over, on_other_nodes
from trainer.captures.batches import Batch, signal_variance
from trainer.device import array_of
from trainer.effects.definition import STAGES
from trainer.effects.free_form import grid_of, on_other_curve_nodes
from trainer.fitting.free_form_maps import FreeFormBatch, descend
from trainer.fitting.gauss_newton import fit
from trainer.fitting.predictor import Predictor, excess_on
from trainer.model.model import EffectInstance, Model
from trainer.prediction.free_stages import FreeFormStage, Tensors
from trainer.prediction.scene import Stages

PARTS = (18, 36, 72)  # of the grid's shorter side between nodes, coarse to fine
LEAST_SPACING = 6  # samples between nodes: finer than that is no smooth map
CURVE_NODES = (27, 51, 99)  # of a curve, coarse to fine: the coarsest is finer than the polynomials
ITERATIONS, ROUNDS = 6, 5  # between two checks of the captures that say when to stop; most checks
CURVE_ITERATIONS, CURVE_ROUNDS = 10, 12  # a curve's nodes differ much in how many pixels they touch
FIRST_GAIN = 0.25  # share of the error that the coarsest map must remove for the polynomials to have ended
FINER_GAIN = 0.05  # share that more nodes must remove to be kept
DESCENT = (
    0.5  # of what all numbers must remove together: what the nodes must remove, with the others as they are
)
REFIT_ITERATIONS = 3
# Nodes and all other numbers go on in turns while each leaves less than this share. A rough beam on 96 x 128 pixels
# ends at 0.0006 after one turn, and at 0.0001 after four.
TURNS, UNSETTLED = 4, 0.8


def can_go_on(model: Model) -> tuple[str, ...]:
    """Names of a model's effects whose maps or curves may go on in free form."""
    return tuple(p.effect.name for p in model.present if p.effect.free_form is not None)


def with_free_form(
    model: Model,
    name: str,
    fitted: Sequence[Batch],
    stopping: Sequence[Batch],
    enough: float,
) -> Model | None:
    """The model with an effect's map or curve gone on in free form, and everything else refitted with it.

    Maps that had gone on before are fitted together with a new one, on finer nodes, too, where that pays.

    Parameters
    ----------
    model : Model
        With fitted gains.
    name : str
        Of an effect with a free form.
    fitted, stopping : sequence of Batch
        Captures for the gradient, and other captures that say when to stop and how fine the map is.
    enough : float
        Excess on `stopping` below which no finer map is tried.

    Returns
    -------
    Model or None
        None where coarse nodes do not remove a quarter of the error: the polynomials have not ended.
    """
    begun = begun_in_free_form(model, name, fitted, stopping)
    if begun is None:
        return None
    maps = free_maps(begun)
    return settled(begun, maps if name in maps else [name], fitted, stopping, enough)


def begun_in_free_form(
    model: Model, name: str, fitted: Sequence[Batch], stopping: Sequence[Batch]
) -> Model | None:
    """The model with an effect's map or curve on the coarsest nodes; None where these remove less than a quarter."""
    least = excess_on(model, stopping)
    needed = FIRST_GAIN * abs(least)
    shape = _node_shapes(model, name, fitted[0])[0]
    trial, excess = _turn(model, {name: shape}, fitted, stopping, needed)
    return None if least - excess < needed else trial


def settled(
    model: Model,
    names: Sequence[str],
    fitted: Sequence[Batch],
    stopping: Sequence[Batch],
    enough: float,
) -> Model:
    """The model with some maps, or a curve, fitted together on finer nodes while that pays, in turns with all else.

    Together, because a map that is fitted while another one is coarse or still polynomials takes up some of its work.

    Parameters
    ----------
    enough : float
        Excess on `stopping` that ends it.
    """
    least = excess_on(model, stopping)
    while least >= enough and (finer := _finer(model, names, fitted[0])):
        needed = FINER_GAIN * abs(least)
        trial, excess = _turn(model, finer, fitted, stopping, needed)
        if least - excess < needed:
            break
        model, least = trial, excess
    for _ in range(TURNS):
        if least < enough:
            break
        trial, excess = _turn(model, dict.fromkeys(names), fitted, stopping)
        before = least
        if excess < least:
            model, least = trial, excess
        if excess > UNSETTLED * before:
            break
    return model


def _finer(model: Model, names: Sequence[str], batch: Batch) -> dict[str, tuple[int, int] | None]:
    """The next finer nodes of each map or curve, None for one that has the finest; empty where all have."""
    found: dict[str, tuple[int, int] | None] = {}
    for name in names:
        nodes = model.instance(name).nodes
        assert nodes is not None
        finer = [s for s in _node_shapes(model, name, batch) if s[1] > nodes.shape[-1]]
        found[name] = finer[0] if finer else None
    return found if any(found.values()) else {}


def free_maps(model: Model) -> list[str]:
    """Names of effects whose maps have gone on in free form."""
    return [p.effect.name for p in _with_a_map(model) if p.nodes is not None]


def polynomial_maps(model: Model) -> list[str]:
    """Names of effects whose maps are polynomials alone and may go on in free form."""
    return [p.effect.name for p in _with_a_map(model) if p.nodes is None]


def _with_a_map(model: Model) -> list[EffectInstance]:
    """A model's effects whose free form is a map."""
    forms = [(p, p.effect.free_form) for p in model.present]
    return [p for p, form in forms if form is not None and not form.curve]


def _turn(
    model: Model,
    nodes: Mapping[str, tuple[int, int] | None],
    fitted: Sequence[Batch],
    stopping: Sequence[Batch],
    needed: float = 0.0,
) -> tuple[Model, float]:
    """The model with some effects' nodes fitted, then all other numbers, and its excess on `stopping`.

    Where the nodes alone remove less than DESCENT of the excess that is needed, other numbers stay as they are, and
    where these then leave more on `stopping`: few captures may say too little of a response, say, where it saturates.
    """
    trial = _descended(model, nodes, fitted, stopping, DESCENT * needed)
    excess = excess_on(trial, stopping)
    if needed and excess_on(model, stopping) - excess < DESCENT * needed:
        return trial, excess
    refitted = fit(trial, trial.names, fitted, iterations=REFIT_ITERATIONS).model
    left = excess_on(refitted, stopping)
    return (refitted, left) if left < excess else (trial, excess)


def refined(model: Model, fitted: Sequence[Batch], stopping: Sequence[Batch]) -> Model:
    """The model with its free-form maps fitted again, together, and each of its curves, on the nodes that they have."""
    maps = free_maps(model)
    curves = [p.effect.name for p in model.present if p.nodes is not None and p.effect.name not in maps]
    for names in (maps, *([name] for name in curves)):
        if names:
            model = _descended(model, dict.fromkeys(names), fitted, stopping)
    return model


def _descended(
    model: Model,
    nodes: Mapping[str, tuple[int, int] | None],
    fitted: Sequence[Batch],
    stopping: Sequence[Batch],
    needed: float | None = None,
) -> Model:
    """The model with some effects' nodes fitted, on as many as are given for each or on those that it has."""
    for name, shape in nodes.items():
        if shape is not None:
            grid, colours = _grid(model, name, fitted[0]), len(model.bench.channels)
            present = model.instance(name)
            model = model.having(replace(present, nodes=_on_nodes(present, shape, grid, colours)))
    those = [model.instance(name) for name in nodes]
    parts = [[FreeFormBatch(model, b) for b in batches] for batches in (fitted, stopping)]
    scale = signal_variance(fitted)
    curve = all(p.effect.free_form is not None and p.effect.free_form.curve for p in those)
    iterations, rounds = (CURVE_ITERATIONS, CURVE_ROUNDS) if curve else (ITERATIONS, ROUNDS)
    error = -math.inf if needed is None else needed * signal_variance(stopping)
    stage = _stage_of(model, those)
    found = descend(stage, parts[0], parts[1], scale, iterations, rounds, needed=error)
    for present in those:
        assert present.nodes is not None
        more = array_of(found[present.effect.name].double())
        model = model.having(replace(present, nodes=present.nodes + more))
    return model


def _node_shapes(model: Model, name: str, batch: Batch) -> list[tuple[int, int]]:
    """Rows and columns of nodes to try, coarse to fine; of a curve, a row for all colours or one for each."""
    effect = model.instance(name).effect
    if effect.free_form is not None and effect.free_form.curve:
        rows = len(model.bench.channels) if any(p.per_channel for p in effect.parameters) else 1
        return [(rows, count) for count in CURVE_NODES]
    grid = _grid(model, name, batch)
    spacings = [max(min(grid) / parts, LEAST_SPACING) for parts in PARTS]
    # One that is hardly coarser than the next costs as much and shows nothing else.
    kept = [s for s, finer in pairwise(spacings) if s > 1.5 * finer]
    return [nodes_over(grid, spacing) for spacing in (*kept, spacings[-1])]


def _on_nodes(
    present: EffectInstance, shape: tuple[int, int], grid: tuple[int, int], colours: int
) -> np.ndarray:
    """An effect's nodes on as many others; zero where it has none. One that came apart has a map for each colour."""
    if present.effect.free_form is not None and present.effect.free_form.curve:
        return np.zeros(shape) if present.nodes is None else on_other_curve_nodes(present.nodes, shape[1])
    if present.nodes is None:
        return np.zeros((colours, *shape) if present.effect.in_common is not None else shape)
    maps = present.nodes.reshape(-1, *present.nodes.shape[-2:])
    others = np.stack([on_other_nodes(one, shape, grid) for one in maps])
    return others.reshape(*present.nodes.shape[:-2], *shape)


def _grid(model: Model, name: str, batch: Batch) -> tuple[int, int]:
    """Samples of the grid that an effect's map lies on."""
    stages = Predictor(model, batch).stages(model)
    return grid_of(getattr(stages, model.instance(name).effect.stage))


def _stage_of(model: Model, those: Sequence[EffectInstance]) -> FreeFormStage:
    """What some effects' nodes change, where these are free."""
    colours = [c.name for c in model.bench.channels]
    forms, shapes = {}, {}
    for present in those:
        effect, nodes = present.effect, present.nodes
        assert effect.free_form is not None and nodes is not None
        forms[effect.name] = effect.stage, effect.free_form
        # A step of the optimiser's variables is one of many nodes at once.
        shapes[effect.name] = nodes.shape, 5 * effect.free_form.scale * float(np.sqrt(nodes.size))

    def apply(stages: Stages, maps: Tensors) -> Stages:
        for name, (stage, form) in forms.items():
            one = getattr(stages, stage)
            stages = replace(stages, **{stage: form.added(one, maps[name], colours.index(one.channel))})
        return stages

    first = min((stage for stage, _ in forms.values()), key=STAGES.index)
    return FreeFormStage(first, shapes, apply, lambda maps: [])
