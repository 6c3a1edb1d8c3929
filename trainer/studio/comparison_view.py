"""Measured, predicted and difference of any capture: one scale, linked pan and zoom, values under the cursor, a wipe.

Large pictures are shown as means of blocks, and pixel by pixel where one has zoomed in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import RangesUpdate
from bokeh.models import BoxZoomTool, ColumnDataSource, HoverTool, LinearColorMapper, Range1d
from bokeh.plotting import figure

from firmware_iface.errors import InputError
from trainer.diagnosis.comparison import CapturePicture
from trainer.formatting import number
from trainer.model.model import Model
from trainer.model.model_file import read_model
from trainer.report.heat_maps import blocks
from trainer.studio.colours import MISSING, difference_palette, irradiance_palette
from trainer.studio.job_tasks import CapturePrediction, block_side, shown_as
from trainer.studio.project import Project
from trainer.studio.visit import Visit

NOTHING = np.zeros((2, 2), np.float32)
KINDS = ("measured", "predicted", "difference")
TITLES = {
    "measured": "Measured",
    "predicted": "Predicted",
    "difference": "Measured − predicted",
    "wipe": "Measured | predicted",
    "predicted_2": "Predicted by the other",
    "difference_2": "Measured − the other",
}
IDEAL = "the ideal model"


class LinkedPictures:
    """Pictures of one capture on common axes."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        height, width = shape
        self.x: Any
        self.y: Any
        self.x, self.y = (
            Range1d(start=0, end=width, bounds=(0, width)),
            Range1d(start=height, end=0, bounds=(0, height)),
        )
        self.light: Any = LinearColorMapper(
            palette=list(irradiance_palette()), low=0, high=1, nan_color=MISSING
        )
        self.apart: Any = LinearColorMapper(
            palette=list(difference_palette()), low=-1, high=1, nan_color=MISSING
        )
        empty = [np.zeros((2, 2), np.float32)]
        self.source = ColumnDataSource(
            {**{k: empty for k in TITLES}, "x": [0], "y": [0], "dw": [width], "dh": [height]}
        )
        self.shown: CapturePrediction | None = None
        self.other: CapturePrediction | None = None
        self.wipe_at = 0.5
        self.is_wiped = False
        self._view: tuple[int, int, int, int, int] | None = None

    def figure(self, kind: str) -> Any:
        """One of the pictures."""
        height, width = self.shape
        one: Any = figure(
            x_range=self.x,
            y_range=self.y,
            tools="pan,wheel_zoom,reset",
            active_scroll="wheel_zoom",
            toolbar_location=None,
            min_border=0,
            lod_timeout=120,  # ms after a zoom until finer pixels are asked for
            width=400,
            height=max(1, round(400 * height / width)),
            sizing_mode="scale_width",
        )
        one.add_tools(BoxZoomTool(match_aspect=True))
        one.axis.visible = False
        one.grid.visible = False
        mapper = self.apart if kind.startswith("difference") else self.light
        drawn = one.image(kind, x="x", y="y", dw="dw", dh="dh", source=self.source, color_mapper=mapper)
        rows = [
            ("row, column", "$y{0}, $x{0}"),
            ("measured", "@measured{0.0}"),
            ("predicted", "@predicted{0.0}"),
        ]
        rows.append(("difference", "@difference{0.0}"))
        if kind.endswith("_2"):
            rows += [("predicted, other", "@predicted_2{0.0}"), ("difference, other", "@difference_2{0.0}")]
        one.add_tools(HoverTool(tooltips=rows, renderers=[drawn], attachment="horizontal"))
        return one

    def show(self, found: CapturePrediction, other: CapturePrediction | None) -> None:
        """Show a capture, at the present zoom."""
        self.shown, self.other, self._view = found, other, None
        light, apart = found.light, found.apart
        if other is not None:
            apart = max(apart, other.apart)
        self.light.update(low=0.0, high=light)
        self.apart.update(low=-apart, high=apart)
        self.redraw()

    def redraw(self, _: Any = None) -> None:
        """Show the part of the pictures that is in view, as fine as the screen."""
        if self.shown is None:
            return
        left, right, top, bottom = self._in_view()
        factor = block_side(max(right - left, bottom - top))
        left, top = left // factor * factor, top // factor * factor
        view = (left, right, top, bottom, factor)
        if view == self._view:
            return
        self._view = view
        arrays = self._arrays(self.shown, view, "")
        if self.other is not None:
            arrays |= self._arrays(self.other, view, "_2")
            del arrays["measured_2"]
        else:  # what is not shown is not sent
            arrays |= {"predicted_2": NOTHING, "difference_2": NOTHING}
        rows, columns = arrays["measured"].shape
        place = {"x": [left], "y": [top], "dw": [columns * factor], "dh": [rows * factor]}
        self._pictures = arrays
        self.source.data = {
            **{k: [a] for k, a in arrays.items()},
            "wipe": [self._wiped(left, factor)],
            **place,
        }

    def wipe(self, share: float) -> None:
        """Move the edge between measured and predicted to a share of the picture's width."""
        self.wipe_at = share
        if self.shown is not None and self._view is not None:
            self.source.patch({"wipe": [(0, self._wiped(self._view[0], self._view[4]))]})

    def _wiped(self, left: int, factor: int) -> np.ndarray:
        if not self.is_wiped:
            return NOTHING
        edge = round((self.wipe_at * self.shape[1] - left) / factor)
        columns = np.arange(self._pictures["measured"].shape[1])
        return np.where(columns < edge, self._pictures["measured"], self._pictures["predicted"]).astype(
            np.float32
        )

    def _in_view(self) -> tuple[int, int, int, int]:
        height, width = self.shape
        left, right = sorted((float(self.x.start), float(self.x.end)))
        top, bottom = sorted((float(self.y.start), float(self.y.end)))
        if right - left > 0.97 * width and bottom - top > 0.97 * height:
            return 0, width, 0, height
        # a border of a quarter, so that a small pan needs no new picture
        x_room, y_room = 0.25 * (right - left), 0.25 * (bottom - top)
        return (
            max(0, int(left - x_room)),
            min(width, int(right + x_room) + 1),
            max(0, int(top - y_room)),
            min(height, int(bottom + y_room) + 1),
        )

    def _arrays(
        self, found: CapturePrediction, view: tuple[int, int, int, int, int], tail: str
    ) -> dict[str, np.ndarray]:
        left, right, top, bottom, factor = view
        if factor in found.levels:
            rows = slice(top // factor, -(-bottom // factor))
            measured, predicted, difference = found.levels[factor][
                :, rows, left // factor : -(-right // factor)
            ]
        else:
            part = (slice(top, bottom), slice(left, right))
            measured, predicted = found.measured[part], found.predicted[part]
            difference = np.where(found.valid[part], measured - predicted, np.nan).astype(np.float32)
            measured, predicted, difference = (
                blocks(a, factor).astype(np.float32) for a in (measured, predicted, difference)
            )
        return {f"measured{tail}": measured, f"predicted{tail}": predicted, f"difference{tail}": difference}


def pictures_view(pictures: Sequence[CapturePicture]) -> Any:
    """Pictures of a comparison, linked as in the studio, for a notebook or a file."""
    rows = []
    for one in pictures:
        linked = LinkedPictures(one.measured.shape)
        linked.show(
            shown_as(one.capture, one.measured, one.predicted, np.isfinite(one.difference), None), None
        )
        plots = [pn.pane.Bokeh(linked.figure(kind), sizing_mode="scale_width") for kind in KINDS]
        cells = [
            pn.Column(f"**{TITLES[kind]}**, {one.capture}", plot, styles={"flex": "1 1 200px"})
            for kind, plot in zip(KINDS, plots, strict=True)
        ]
        rows.append(pn.FlexBox(*cells, sizing_mode="stretch_width"))
    return pn.Column(*rows, sizing_mode="stretch_width")


def comparison_view(project: Project, visit: Visit) -> Any:
    """The pictures, and what is shown in them."""
    if project.set.captures is None:
        return pn.pane.HTML("<p class='quiet'>There are no captures to compare.</p>", css_classes=["card"])
    shape = project.set.captures.bench.camera.shape
    pictures = LinkedPictures(shape)
    place = pn.FlexBox(gap="12px", sizing_mode="stretch_width")
    note = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    scales = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    colour = pn.widgets.Select(
        name="Colour", options=list(project.set.captures.channels), width=110, margin=0
    )
    planes = {f"{z:g} mm": z for z in project.set.captures.planes}
    plane = pn.widgets.Select(name="Plane", options=planes, width=110, margin=0)
    capture = pn.widgets.Select(name="Capture", options=[], width=230, margin=0)
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
        if found is not pictures.shown or other is not pictures.other:
            pictures.show(found, other)
        note.object = _words(project, found)
        scales.object = _scales(pictures)

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


def _scales(pictures: LinkedPictures) -> str:
    """Colour bars: one for light, one for differences."""

    def bar(palette: Callable[[], tuple[str, ...]], low: float, high: float, words: str) -> str:
        colours = palette()
        stops = ", ".join(colours[k] for k in range(0, len(colours), (len(colours) - 1) // 8))
        return (
            f"<div class='scale'><span>{number(low)}</span><i style='background:linear-gradient(90deg,{stops})'></i>"
            f"<span>{number(high)}</span><small>{words}</small></div>"
        )

    return (
        "<div class='scales'>"
        + bar(
            irradiance_palette,
            pictures.light.low,
            pictures.light.high,
            "counts above black, measured and predicted",
        )
        + bar(difference_palette, pictures.apart.low, pictures.apart.high, "counts, difference")
        + "</div>"
    )
