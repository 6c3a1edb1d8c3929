"""The scenes of a model, and its stages: the bench's own with the model's effects and what was learned."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from trainer.captures.bench_file import Bench
from trainer.captures.capture_table import Moment
from trainer.effects.definition import STAGES
from trainer.effects.own_effect import applied
from trainer.kept_results import kept_for_same
from trainer.model.model import EffectInstance, Model
from trainer.prediction.free_stages import with_learned
from trainer.prediction.predict import bare_irradiance
from trainer.prediction.scene import Scene, Stages, bare_stages, scene_at
from trainer.prediction.stages import Pupil

REACH_ROOM = 1.05  # how far beyond the stated plane the grid's own room suffices
LEAST_IRIS = 0.02  # half width whose figure still gets room: an effect of one's own may give none
IRIS_ROOM = 1.25  # how far an effect may open or move the iris, over what the bench says or where it is


def scene_for(model: Model, channel: str, plane_mm: float, dtype: torch.dtype = torch.float32) -> Scene:
    """The scene of a model for one colour and plane.

    Raises
    ------
    InputError
        Where the propagation method's sampling does not reach the plane.
    """
    stated = model.bench.iris.half_width
    opened = IRIS_ROOM if any(p.effect.touches_iris for p in model.present) else 1.0
    scene = scene_at(model.bench, channel, plane_mm, model.method, opened, dtype)
    pupil_effects = tuple(p for p in model.present if p.effect.stage == "pupil")
    pupil = stages_for(scene, pupil_effects).pupil
    # In steps, so that fits whose distance or iris varies a little share their grids.
    wider = _steps(_outermost(pupil) / stated, IRIS_ROOM) if opened > 1 else 0
    farther = _steps(1e3 * abs(float(pupil.distance)) / abs(plane_mm), REACH_ROOM)
    closer = _steps(stated / max(float(pupil.half_width), LEAST_IRIS), IRIS_ROOM)
    if farther == closer == wider == 0:
        return scene
    reach_mm = abs(plane_mm) * REACH_ROOM**farther if farther else None
    opened, closed = opened * IRIS_ROOM**wider, IRIS_ROOM**-closer
    return scene_at(model.bench, channel, plane_mm, model.method, opened, dtype, reach_mm, closed)


def _outermost(pupil: Pupil) -> float:
    """How far from the axis the iris reaches along v or u, share of the band; a turned one may reach farther."""
    stretch, (v, u) = float(pupil.stretch), (abs(float(c)) for c in pupil.centre)
    return max(float(pupil.half_width) * (1 - stretch) + v, float(pupil.half_width) * (1 + stretch) + u)


def _steps(ratio: float, step: float) -> int:
    """How many steps beyond the first, each a factor, reach a ratio."""
    if ratio <= step:
        return 0
    return math.ceil(math.log(ratio, step))


def stages_for(
    scene: Scene, present: tuple[EffectInstance, ...], tensors: Any = None, moment: Moment | None = None
) -> Stages:
    """The scene's stages with effects applied in the order of `present`.

    Per-channel parameters are cut to the scene's own colour.

    Parameters
    ----------
    tensors : mapping, optional
        {effect name: {parameter: tensor}} of values to differentiate; the others are taken from `present`.
    moment : Moment, optional
        When the capture was taken; without it, effects that change from capture to capture are left out.

    Raises
    ------
    InputError
        Where an effect of the user's own fails: with its file and line.
    """
    stages = bare_stages(scene)
    made = {}
    for name in STAGES:
        ones = [p for p in present if p.effect.stage == name and (moment or not p.effect.takes_moment)]
        if not ones:
            continue
        at = moment if any(one.effect.takes_moment for one in ones) else None
        if tensors:
            made[name] = _stage(scene, getattr(stages, name), ones, tensors, at)
        else:
            made[name] = KEPT_STAGES[name](scene, getattr(stages, name), at, *ones)
    return replace(stages, **made) if made else stages


def _stage(
    scene: Scene, stage: Any, present: Sequence[EffectInstance], tensors: Any, moment: Moment | None
) -> Any:
    """One stage with its effects."""
    row = scene.channel_row()
    for one in present:
        given = tensors.get(one.effect.name, {})
        arguments: dict[str, Any] = {}
        for p in one.effect.parameters:
            value = given.get(p.name)
            if value is None:
                value = torch.as_tensor(one.values[p.name], dtype=scene.dtype)
            arguments[p.name] = value[row] if p.per_channel else value
        if one.effect.takes_order:
            arguments["order"] = one.order
        if one.effect.takes_moment:
            arguments["moment"] = moment
        stage = applied(one.effect, stage, arguments)
        if one.nodes is not None and one.effect.free_form is not None:
            nodes = torch.as_tensor(one.nodes, dtype=scene.dtype)
            stage = one.effect.free_form.added(stage, nodes, row)
    return stage


def _kept_stages() -> Callable[..., Any]:
    @kept_for_same(2)  # a fit's model and its trial: they differ in one stage, and share the others
    def made(scene: Scene, stage: Any, moment: Moment | None, *present: EffectInstance) -> Any:
        return _stage(scene, stage, present, {}, moment)

    return made


KEPT_STAGES = {name: _kept_stages() for name in STAGES}


def stages_of(scene: Scene, model: Model, tensors: Any = None, moment: Moment | None = None) -> Stages:
    """The scene's stages under a model: its effects, and what was learned at the panel and other stages after them.

    Parameters
    ----------
    tensors : mapping, optional
    moment : Moment, optional
        As in `stages_for`.
    """
    stages = stages_for(scene, model.present, tensors, moment)
    field = {} if model.panel_field is None else {"panel": model.panel_field}
    for stage, maps in {**field, **model.learned}.items():
        stages = with_learned(stages, model.bench, stage, maps)
    if stages.sensor.response is not None and model.response_known_to is not None:
        stages = replace(stages, sensor=replace(stages.sensor, response_known_to=model.response_known_to))
    return stages


def ideal_irradiance(bench: Bench, gray: np.ndarray, channel: str, plane_mm: float) -> np.ndarray:
    """What the bench file alone predicts for one pattern.

    Parameters
    ----------
    gray : uint8 array [H, W]
        Gray levels as sent to the panel.
    plane_mm : float, mm
        Panel to image plane.

    Returns
    -------
    float32 array [h, w]
        In camera pixels, of arbitrary scale.
    """
    return bare_irradiance(scene_for(Model(bench), channel, plane_mm), gray)
