"""The light path across the top: each stage with its effects, and how much of the error that is left is there."""

from __future__ import annotations

from html import escape
from typing import Any

import panel as pn

from trainer.diagnosis.probes import ProbeResult
from trainer.effects.definition import STAGES
from trainer.formatting import measured, number, plain
from trainer.model.model import EffectInstance, Model
from trainer.studio.project import Project
from trainer.studio.visit import Visit

ABOUT = {
    "gray": ("gray level", "the pattern, as it is sent"),
    "drive": ("drive", "gray level to phase"),
    "panel": ("panel", "light on each pixel"),
    "pupil": ("pupil", "propagation and iris"),
    "sensor": ("sensor", "irradiance to signal"),
    "camera": ("camera", "counts and their noise"),
    "network": ("network", "what has no name, booked apart"),
    "field": ("learned field", "the wave at the panel, without a name"),
}
MOST_VALUES = 3


def light_path_view(project: Project, visit: Visit) -> Any:
    """The stages in the order of light, as a list that wraps where the page is narrow."""
    pane = pn.pane.HTML("", sizing_mode="stretch_width", margin=0, css_classes=["light-path"])

    def show() -> None:
        pane.object = _path(project)

    visit.on("set model diagnosis", show)
    return pane


def _path(project: Project) -> str:
    model = project.set.model
    if model is None:
        return ""
    probes = {p.stage: p for p in (project.results.diagnosis.probes if project.results.diagnosis else ())}
    excess = project.results.diagnosis.held_out.excess if project.results.diagnosis else 0.0
    names = ["gray", *STAGES, "camera"]
    if model.panel_field is not None:
        names.insert(names.index("panel") + 1, "field")
    if project.set.network is not None:
        names.insert(names.index("sensor"), "network")
    boxes = "".join(_stage(n, model, probes.get(n), excess) for n in names)
    if probes:
        legend = (
            "The deeper the colour, the more of what is left a free-form probe of the stage would remove."
        )
    elif project.results.diagnosis and project.results.diagnosis.verdict == "complete":
        legend = "What is left is too little to come from a stage."
    else:
        legend = "Diagnose shows at which stage the error that is left comes in."
    return (
        f"<h2 class='hidden'>Light path</h2><ol class='path'>{boxes}</ol><p class='quiet small'>{legend}</p>"
    )


def _stage(name: str, model: Model, probe: ProbeResult | None, excess: float) -> str:
    title, about = ABOUT[name]
    effects = "".join(_effect(one, model) for one in model.present if one.effect.stage == name)
    if name == "gray":
        board = model.bench.panel
        effects = f"<small>{board.width} × {board.height}, {board.levels:g} levels</small>"
    if name == "camera":
        camera = model.bench.camera
        words = f"{camera.bit_depth} bits, black {camera.black_level:g}, {number(camera.full_well_e)} e⁻"
        effects = f"<small>{words}</small>"
    style, share_text = "", ""
    if probe is not None and excess > 0:
        share = max(0.0, min(1.0, probe.removed.value / excess))
        style = f" class='probed' style='--share:{share:.3f}'"
        share_text = f"<em>{100 * share:.0f} % of what is left</em>"
    return f"<li{style}><b>{title}</b><span class='about'>{about}</span>{effects}{share_text}</li>"


def _effect(one: EffectInstance, model: Model) -> str:
    rows = []
    for p in one.effect.parameters:
        values = one.values[p.name]
        errors = one.errors[p.name] if one.errors is not None else values * 0
        if values.size > 4:
            rms = number(float((values**2).mean() ** 0.5))
            rows.append(f"{plain(p.name)}: {values.size} numbers, rms {rms} {_unit(p.unit)}")
            continue
        pairs = zip(values.reshape(-1), errors.reshape(-1), strict=True)
        text = ", ".join(measured(float(v), float(e) or None) for v, e in pairs)
        if text:
            rows.append(f"{plain(p.name)} {text} {_unit(p.unit)}")
    shown = "".join(f"<small>{escape(row)}</small>" for row in rows[:MOST_VALUES])
    title = escape("; ".join(rows))
    return (
        f"<div class='effect' title='{title}'><strong>{escape(plain(one.effect.name))}</strong>{shown}</div>"
    )


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit
