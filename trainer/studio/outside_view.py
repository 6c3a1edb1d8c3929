"""When nothing named fits: the probes' pictures, and the ways on: learn it without a name, or write the effect."""

from __future__ import annotations

from html import escape
from typing import Any

import panel as pn

from firmware_iface.errors import InputError
from trainer.diagnosis.diagnosis import Diagnosis
from trainer.effects.definition import STAGES
from trainer.report.diagnosis_sections import stages, stages_html
from trainer.studio.probe_template import write_effect_of_probe
from trainer.studio.project import Project
from trainer.studio.visit import Visit


def outside_view(project: Project, visit: Visit) -> Any:
    """The probes' pictures next to the three ways on."""
    pictures = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    learn = pn.widgets.Button(name="Learn the field", css_classes=["main-button"], margin=0)
    train = pn.widgets.Button(name="Train a network", css_classes=["plain-button"], margin=0)
    steps = pn.widgets.IntInput(
        name="Steps of training", value=400, start=10, end=100_000, width=140, margin=0
    )
    stage = pn.widgets.Select(name="Stage", options=list(STAGES), width=120, margin=0)
    name = pn.widgets.TextInput(name="Name of the effect", value="my_effect", width=200, margin=0)
    write = pn.widgets.Button(name="Write the effect file", css_classes=["main-button"], margin=0)
    files = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    learn.on_click(lambda _: project.learn_field())
    train.on_click(lambda _: project.train_network(int(steps.value or 400)))

    def written(_: Any) -> None:
        if project.set.captures is None:
            return
        bench = project.set.captures.bench
        found = (
            None
            if project.results.diagnosis is None
            else next((p for p in project.results.diagnosis.probes if p.stage == stage.value), None)
        )
        shape = bench.camera.shape if stage.value == "sensor" else bench.panel.shape
        try:
            path = write_effect_of_probe(
                (name.value_input or name.value or "").strip(),
                stage.value,
                found,
                shape,
                project.home,
                project.effects.known,
            )
        except (InputError, OSError) as error:
            project.say(str(error), "error")
            return
        project.add_effect_file(path)
        project.say(
            f"{path} is written and watched: edit it, and each time you save it, it takes part at once."
        )

    write.on_click(written)

    def show() -> None:
        found = project.results.diagnosis
        if found is None or not found.probes:
            pictures.object = (
                "<p class='quiet'>Diagnose fits each stage's free-form probe; its pictures come here.</p>"
            )
        else:
            pictures.object = _pictures(found)
            if found.stage in STAGES:
                stage.value = found.stage

    def work() -> None:
        idle = project.work is None and project.set.captures is not None
        learn.disabled = train.disabled = write.disabled = not idle

    def listed() -> None:
        rows = "".join(f"<li><code>{escape(str(p))}</code></li>" for p in project.effects.paths)
        fault = f"<p class='bad-text'>{escape(project.effects.fault)}</p>" if project.effects.fault else ""
        files.object = (f"<h3>Watched files</h3><ul>{rows}</ul>" if rows else "") + fault

    visit.on("diagnosis model", show)
    visit.on("job set", work)
    visit.on("effects", listed)
    left = pn.Column(
        pn.pane.HTML("<h2>What each stage lacks</h2>", margin=0),
        pictures,
        css_classes=["card"],
        styles={"flex": "3 1 520px", "min-width": "0"},
    )
    named = pn.Column(
        pn.pane.HTML(
            "<h2>Write an effect</h2><p class='quiet'>A file with a working effect of the stage, with what the probe "
            "shows filled in: open it in your editor. Each time you save it, it is fitted at once, and its picture "
            "stands among the candidates.</p>",
            margin=0,
        ),
        pn.FlexBox(stage, name, gap="10px"),
        write,
        files,
        css_classes=["card", "choice"],
    )
    unnamed = pn.Column(
        pn.pane.HTML(
            "<h2>Learn it without a name</h2><p class='quiet'>A map of the wave at the panel holds what is fixed to "
            "the panel: stripes, dust. A network holds what is left after that; it is booked apart.</p>",
            margin=0,
        ),
        pn.FlexBox(learn, gap="10px"),
        pn.FlexBox(steps, train, gap="10px", align_items="flex-end"),
        css_classes=["card", "choice"],
    )
    right = pn.Column(unnamed, named, styles={"flex": "2 1 320px", "min-width": "0"})
    return pn.FlexBox(left, right, gap="16px", align_items="flex-start", sizing_mode="stretch_width")


def _pictures(found: Diagnosis) -> str:
    section = stages(found.as_json(), found.probe_pictures)
    if section is None or not section["groups"]:
        return "<p>No stage's probe finds anything.</p>"
    return str(stages_html(section))
