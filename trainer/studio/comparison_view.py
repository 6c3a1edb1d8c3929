"""The pictures of any capture, and what is shown in them: colour, plane, capture, wipe, and a second model."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import panel as pn
from bokeh.events import RangesUpdate

from firmware_iface.errors import InputError
from trainer.formatting import number
from trainer.model.model import Model
from trainer.model.model_file import read_model
from trainer.studio.job_tasks import CapturePrediction
from trainer.studio.linked_pictures import KINDS, TITLES, LinkedPictures, scales_html
from trainer.studio.project import Project
from trainer.studio.prompt_select import PromptSelect
from trainer.studio.visit import Visit

IDEAL = "the ideal model"


def comparison_view(project: Project, visit: Visit) -> Any:
    """The pictures, and what is shown in them."""
    if project.set.captures is None:
        return pn.pane.HTML("<p class='quiet'>There are no captures to compare.</p>", css_classes=["card"])
    shape = project.set.captures.bench.camera.shape
    pictures = LinkedPictures(shape)
    place = pn.FlexBox(gap="12px", sizing_mode="stretch_width")
    note = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    scales = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    colour = PromptSelect(name="Colour", options=list(project.set.captures.channels), width=100, margin=0)
    planes = {f"{z:g} mm": z for z in project.set.captures.planes}
    plane = PromptSelect(name="Plane", options=planes, width=100, margin=0)
    capture = PromptSelect(name="Capture", options=[], width=250, margin=0)
    way = pn.widgets.Select(name="Pictures", options=["side by side", "wipe"], width=130, margin=0)
    wipe = pn.widgets.IntSlider(
        name="Wipe, % of the width", start=0, end=100, value=50, step=1, width=220, margin=0
    )
    compare = pn.widgets.Button(name="Compare", css_classes=["plain-button"], margin=0, align="end")
    second = pn.widgets.Select(name="Second model", options=[IDEAL], width=190, margin=0)
    wipe.visible = second.visible = False
    built: list[tuple[str, ...]] = []
    made: dict[str, Any] = {}

    def layout() -> None:
        kinds = ("wipe", "difference") if way.value == "wipe" else KINDS
        if project.set.other is not None:
            kinds = (*kinds, "predicted_2", "difference_2")
        if built == [kinds]:
            return
        built[:] = [kinds]
        for kind in kinds:
            if kind not in made:
                plot = pictures.figure(kind)
                if not made:
                    plot.on_event(RangesUpdate, pictures.redraw)
                made[kind] = pn.pane.Bokeh(plot, sizing_mode="scale_width", margin=0)
        share = "50%" if way.value == "wipe" and project.set.other is None else "33.3%"
        place[:] = [
            pn.Column(
                pn.pane.HTML(f"<h3>{TITLES[k]}</h3>", margin=0),
                made[k],
                styles={"flex": f"0 1 calc({share} - 8px)", "min-width": "min(100%, 180px)"},
                margin=0,
            )
            for k in kinds
        ]

    def list_captures() -> None:
        if project.set.captures is None:
            return
        held = {c.capture for c in project.set.held_out}
        errors = project.set.errors
        excess = {} if errors is None else {one.capture: one.errors.excess for one in errors.captures}
        options = {}
        for c in project.set.captures.captures:
            if c.channel == colour.value and c.plane_mm == plane.value:
                tail = "held out" if c.capture in held else "fitted"
                if c.capture in excess:
                    tail += f", excess {number(excess[c.capture], 2)}"
                options[f"{c.capture} ({tail})"] = c.capture
        chosen = visit.capture if visit.capture in options.values() else None
        if chosen is None and options:
            chosen = next((c for c in options.values() if c in held), next(iter(options.values())))
        if options != capture.options:
            capture.param.update(options=options, value=chosen)
        elif capture.value != chosen:
            capture.value = chosen

    def show() -> None:
        name = visit.capture
        found = project.set.pictures.prediction(name) if name else None
        other = (
            project.set.pictures.prediction(name, of_other=True)
            if name and project.set.other is not None
            else None
        )
        layout()
        if found is None:
            fault = project.set.pictures.fault(name)
            note.object = (
                f"<p class='{'bad-text' if fault else 'quiet'}'>{escape(fault) or 'Predicting …'}</p>"
            )
            return
        with pn.io.hold(visit.document):  # one message, not one for each change
            if found is not pictures.shown or other is not pictures.other:
                pictures.show(found, other)
            note.object = _words(project, found)
            scales.object = scales_html(pictures)

    def choose(event: Any) -> None:
        if event.new and event.new != visit.capture:
            visit.capture = event.new

    def jump(event: Any) -> None:
        """Another view has chosen a capture."""
        rows = project.set.captures.captures if project.set.captures is not None else ()
        row = next((c for c in rows if c.capture == event.new), None)
        if row is not None and (row.channel, row.plane_mm) != (colour.value, plane.value):
            colour.value, plane.value = row.channel, row.plane_mm
        list_captures()
        show()

    def ways(_: Any) -> None:
        wipe.visible = pictures.is_wiped = way.value == "wipe"
        pictures.wipe(pictures.wipe_at)
        layout()

    def toggle(_: Any) -> None:
        if project.set.other is not None:
            project.compare_with("", None)
        else:
            second.visible = True
            _compare(project, second.value)

    def others() -> None:
        second.options = [IDEAL, *project.set.earlier_models()]
        second.visible = project.set.other is not None
        compare.name = "Compare" if project.set.other is None else "Compare no more"
        layout()
        show()

    colour.param.watch(lambda _: list_captures(), "value")
    plane.param.watch(lambda _: list_captures(), "value")
    capture.param.watch(choose, "value")
    visit.param.watch(jump, "capture")
    way.param.watch(ways, "value")
    wipe.param.watch(lambda event: pictures.wipe(event.new / 100), "value")
    second.param.watch(
        lambda event: _compare(project, event.new) if project.set.other is not None else None, "value"
    )
    compare.on_click(toggle)
    visit.on("errors set", list_captures)
    visit.on("picture model", show, now=False)
    visit.on("other", others, now=False)
    show()
    return pn.Column(
        pn.pane.HTML("<h2>Measured and predicted</h2>", margin=0),
        pn.FlexBox(colour, plane, capture, way, wipe, compare, second, gap="10px", align_items="flex-end"),
        note,
        place,
        scales,
        css_classes=["card"],
        sizing_mode="stretch_width",
    )


def _compare(project: Project, name: str) -> None:
    """Show a second model: the ideal one, or an earlier step."""
    captures = project.set.captures
    if captures is None:
        return
    try:
        if name == IDEAL:
            model = Model(captures.bench)
        else:
            path: Path = project.set.earlier_models()[name]
            model = read_model(path, project.effects.known, captures.bench)
    except (InputError, KeyError) as error:
        project.say(str(error), "error")
        return
    project.compare_with(name, model)


def _words(project: Project, found: CapturePrediction) -> str:
    errors = found.errors
    if errors is None:
        return f"<p>Capture {escape(found.capture)}: every pixel is saturated.</p>"
    excess = f", excess <b>{number(errors.errors.excess)}</b>" if errors.has_contrast else ""
    lost = 1 - float(found.valid.mean())
    saturated = f"; {100 * lost:.2g} % saturated, gray" if lost > 0 else ""
    other = "" if project.set.other is None else f"; next to {escape(project.set.other[0])}"
    return (
        f"<p>Capture <b>{escape(found.capture)}</b>, {escape(errors.channel)}, {errors.plane_mm:g} mm{excess}"
        f"{saturated}{other}. Drag to pan, wheel to zoom; the pictures move together.</p>"
    )
