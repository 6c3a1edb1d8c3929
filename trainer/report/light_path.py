"""The light path: each stage with its effects, and how much of the error that is left is there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from trainer.effects.definition import STAGES
from trainer.formatting import number, parameters, plain
from trainer.model.model import EffectInstance, Model
from trainer.model.parameters import json_values

ABOUT = {
    "gray": ("gray level", "the pattern, as it is sent"),
    "drive": ("drive", "gray level to phase"),
    "panel": ("panel", "light on each pixel"),
    "field": ("learned field", "the wave at the panel, without a name"),
    "pupil": ("pupil", "propagation and iris"),
    "sensor": ("sensor", "irradiance to signal"),
    "camera": ("camera", "counts and their noise"),
    "network": ("network", "what has no name, booked apart"),
}
MOST_VALUES = 3
STAGE = Markup('<li{shade}><b>{title}</b><span class="about">{about}</span>{held}{share}</li>')
EFFECT = Markup('<div class="effect" title="{every}"><strong>{name}</strong>{values}</div>')
SMALL = Markup("<small>{}</small>")


def light_path_html(
    model: Model, found: Mapping[str, Any] | None, network: tuple[float, float] | None = None
) -> Markup:
    """The stages in the order of light, as a list that wraps where the page is narrow.

    Parameters
    ----------
    found : mapping or None
        The object of `diagnose --json`: what each stage's probe would remove is the depth of its colour.
    network : (float, float) or None
        Excess on held-out captures without and with a learned network.
    """
    excess = float(found["heldout"]["excess"] or 0.0) if found else 0.0
    removed = {str(r["stage"]): float(r["excess_removed"]) for r in (found or {}).get("stages") or []}
    names = ["gray", *STAGES, "camera"]
    if model.panel_field is not None:
        names.insert(names.index("panel") + 1, "field")
    if network is not None:
        names.insert(names.index("sensor"), "network")
    stages = Markup("").join(_stage(n, model, removed.get(n), excess, network) for n in names)
    if removed:
        legend = (
            "The deeper the colour, the more of what is left a free-form probe of the stage would remove."
        )
    elif found and found.get("verdict") == "complete":
        legend = "What is left is too little to come from a stage."
    else:
        legend = "Diagnose shows at which stage the error that is left comes in."
    return Markup(
        '<h2 class="hidden">Light path</h2><ol class="path">{}</ol><p class="quiet small">{}</p>'
    ).format(stages, legend)


def _stage(
    name: str, model: Model, removed: float | None, excess: float, network: tuple[float, float] | None
) -> Markup:
    title, about = ABOUT[name]
    held = Markup("").join(_effect(one, model) for one in model.present if one.effect.stage == name)
    if name in model.learned:
        held += EFFECT.format(every="", name="learned, without a name", values="")
    if name == "gray":
        board = model.bench.panel
        held = SMALL.format(f"{board.width} × {board.height}, {board.levels:g} levels")
    if name == "camera":
        camera = model.bench.camera
        held = SMALL.format(
            f"{camera.bit_depth} bits, black {camera.black_level:g}, {number(camera.full_well_e)} e⁻"
        )
    if name == "network" and network is not None:
        held = SMALL.format(f"excess {number(network[1], 2)}, from {number(network[0], 2)}")
    shade = share = Markup("")
    if removed is not None and excess > 0:
        part = max(0.0, min(1.0, removed / excess))
        shade = Markup(' class="probed" style="--share:{:.3f}"').format(part)
        share = Markup("<em>{:.0f} % of what is left</em>").format(100 * part)
    return STAGE.format(shade=shade, title=title, about=about, held=held, share=share)


def _effect(one: EffectInstance, model: Model) -> Markup:
    rows = [f"{p.name} {p.text}" for p in parameters(json_values(one, model.bench))]
    shown = Markup("").join(SMALL.format(row) for row in rows[:MOST_VALUES])
    return EFFECT.format(every="; ".join(rows), name=plain(one.effect.name), values=shown)
