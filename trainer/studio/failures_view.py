"""Where the model fails: over the field, spatial frequency, brightness and time; a click shows the worst captures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Tap
from bokeh.models import BasicTickFormatter, ColumnDataSource, HoverTool, LinearColorMapper, Range1d
from bokeh.plotting import figure

from trainer.diagnosis.capture_errors import SetErrors
from trainer.formatting import number
from trainer.studio.colours import MISSING, error_palette
from trainer.studio.project import Project
from trainer.studio.visit import Visit

MOST = 5
SMALL = 5e-4  # excess that is too little to explain, and must not fill a plot
Chosen = Callable[[str, list[tuple[str, float]]], None]


def failures_view(project: Project, visit: Visit) -> Any:
    """Four plots on the held-out captures, and the captures that are worst where one has clicked."""
    if project.set.captures is None:
        return pn.Column()
    shape = project.set.captures.bench.camera.shape
    plots: dict[str, Any] = {
        "field": _Field(shape),
        "frequency": _Frequency(visit),
        "brightness": _Brightness(visit),
        "time": _Time(visit),
    }
    places: dict[str, Any] = {}
    words = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    worst = pn.FlexBox(gap="6px")
    where = pn.widgets.Select(name="Worst captures", options=["over everything"], width=260, margin=0)

    def chosen(title: str, captures: list[tuple[str, float]]) -> None:
        buttons = []
        for name, value in captures[:MOST]:
            button = pn.widgets.Button(
                name=f"{name}: {number(value, 2)}", css_classes=["plain-button"], margin=0
            )
            button.on_click(partial(_look_at, visit, name))
            buttons.append(button)
        words.object = f"<p class='small'>Worst {escape(title)} (click one to see it):</p>"
        worst[:] = buttons

    def pick(event: Any) -> None:
        errors = project.set.errors
        if errors is None:
            return
        if event.new not in places:
            chosen("over everything", _everything(errors))
        else:
            kind, place = places[event.new]
            title, captures = plots[kind].worst(errors, place)
            chosen(title, captures)

    def tapped(kind: str) -> Callable[[Any], None]:
        def act(event: Any) -> None:
            errors = project.set.errors
            if errors is None:
                return
            place = plots[kind].place(errors, event.x, event.y)
            if place is not None:
                chosen(*plots[kind].worst(errors, place))

        return act

    cells, titles = [], {}
    for kind, plot in plots.items():
        plot.figure.on_event(Tap, tapped(kind))
        titles[kind] = pn.pane.HTML(f"<h3>{plot.title}</h3>", margin=0)
        cells.append(
            pn.Column(
                titles[kind],
                pn.pane.Bokeh(plot.figure, sizing_mode=plot.figure.sizing_mode, margin=0),
                styles={"flex": "1 1 calc(50% - 14px)", "min-width": "min(100%, 240px)"},
                margin=0,
            )
        )

    def show() -> None:
        errors = project.set.errors
        if errors is None:
            words.object = "<p class='quiet'>Comparing with the held-out captures …</p>"
            worst[:] = []
            return
        for kind, plot in plots.items():
            plot.show(errors)
            titles[kind].object = f"<h3>{plot.title}</h3>"
        places.clear()
        places.update(_places(errors, plots))
        where.param.update(options=["over everything", *places], value="over everything")
        chosen("over everything", _everything(errors))

    where.param.watch(pick, "value")
    visit.on("errors model", show)
    return pn.Column(
        pn.pane.HTML("<h2>Where the model fails</h2>", margin=0),
        pn.FlexBox(*cells, gap="14px", sizing_mode="stretch_width"),
        pn.FlexBox(
            where,
            pn.Column(words, worst, margin=0, styles={"flex": "1 1 240px"}),
            gap="14px",
            align_items="flex-end",
        ),
        css_classes=["card"],
        sizing_mode="stretch_width",
    )


def _look_at(visit: Visit, capture: str, _: Any) -> None:
    visit.capture = capture


def _everything(errors: SetErrors) -> list[tuple[str, float]]:
    return sorted(((one.capture, one.errors.excess) for one in errors.captures), key=lambda pair: -pair[1])


def _places(errors: SetErrors, plots: dict[str, Any]) -> dict[str, Any]:
    """Places to choose without a mouse."""
    field = np.nan_to_num(errors.field, nan=-1)
    options: dict[str, Any] = {}
    for flat in np.argsort(field, axis=None)[::-1][:3]:
        row, column = (int(k) for k in np.unravel_index(flat, field.shape))
        options[plots["field"].worst(errors, (row, column))[0]] = ("field", (row, column))
    rings = errors.frequency.shape[1]
    for ring in range(1, rings, max(1, rings // 5)):
        options[plots["frequency"].worst(errors, ring)[0]] = ("frequency", ring)
    for step in range(1, errors.brightness.shape[1], 4):
        options[plots["brightness"].worst(errors, step)[0]] = ("brightness", step)
    return options


def _plot(**more: Any) -> Any:
    one: Any = figure(
        height=220, min_border=4, toolbar_location=None, tools="tap", sizing_mode="stretch_width", **more
    )
    one.xgrid.visible = False
    return one


def _curve(plot: Any, over: str, kind: str, colour: str, dash: str) -> None:
    plot.figure.line(
        over, kind, source=plot.source, color=colour, line_dash=dash, line_width=2, legend_label=kind
    )


class _Field:
    """Excess over the picture, in tiles."""

    title = "Over the field"

    def __init__(self, shape: tuple[int, int]) -> None:
        height, width = shape
        self.figure: Any = figure(
            x_range=Range1d(start=0, end=width), y_range=Range1d(start=height, end=0), tools="tap",
            toolbar_location=None, min_border=0, width=260, height=max(1, round(260 * height / width)),
            sizing_mode="scale_width",
        )  # fmt: skip
        self.figure.axis.visible = False
        self.figure.grid.visible = False
        self.mapper: Any = LinearColorMapper(palette=list(error_palette()), low=0, high=1, nan_color=MISSING)
        self.source = ColumnDataSource({"image": [np.zeros((2, 2))], "dw": [width], "dh": [height]})
        plot: Any = self.figure
        drawn = plot.image("image", x=0, y=0, dw="dw", dh="dh", source=self.source, color_mapper=self.mapper)
        self.figure.add_tools(
            HoverTool(
                tooltips=[("excess", "@image{0.0000}"), ("row, column", "$y{0}, $x{0}")], renderers=[drawn]
            )
        )

    def show(self, errors: SetErrors) -> None:
        """Draw."""
        field, tile = errors.field, errors.captures[0].tile_px
        top = float(np.nanmax(field)) if np.isfinite(field).any() else 1.0
        self.mapper.update(low=0.0, high=max(top, SMALL))
        self.title = f"Over the field, excess 0 to {number(max(top, SMALL), 2)}"
        self.source.data = {"image": [field], "dw": [field.shape[1] * tile], "dh": [field.shape[0] * tile]}

    def place(self, errors: SetErrors, x: float, y: float) -> tuple[int, int] | None:
        """The tile at a place."""
        tile, (rows, columns) = errors.captures[0].tile_px, errors.field.shape
        row, column = int(y // tile), int(x // tile)
        return (row, column) if 0 <= row < rows and 0 <= column < columns else None

    def worst(self, errors: SetErrors, place: tuple[int, int]) -> tuple[str, list[tuple[str, float]]]:
        """What a tile is called, and the captures by their excess there."""
        tile = errors.captures[0].tile_px
        row, column = (int((k + 0.5) * tile) for k in place)
        return f"around row {row}, column {column}", errors.worst_at(*place)


class _Frequency:
    """Power of error, noise and signal over spatial frequency."""

    title = "Over spatial frequency"

    def __init__(self, visit: Visit) -> None:
        c = visit.colours
        self.figure = _plot(y_axis_type="log", x_axis_label="cycles/pixel", y_axis_label="power, counts²")
        self.source = ColumnDataSource({k: [0.1, 1.0] for k in ("f", "error", "noise", "signal")})
        for kind, colour, dash in (
            ("signal", c["quiet"], "solid"),
            ("error", c["main"], "solid"),
            ("noise", c["other"], "dashed"),
        ):
            self.figure.line(
                "f", kind, source=self.source, color=colour, line_dash=dash, line_width=2, legend_label=kind
            )
        self.figure.legend.location = "top_right"

    def show(self, errors: SetErrors) -> None:
        """Draw."""
        f, error, noise, signal = errors.frequency
        self.source.data = {"f": f, "error": error, "noise": noise, "signal": signal}

    def place(self, errors: SetErrors, x: float, y: float) -> int | None:
        """The ring at a place."""
        return int(np.argmin(np.abs(errors.frequency[0] - x)))

    def worst(self, errors: SetErrors, place: int) -> tuple[str, list[tuple[str, float]]]:
        """What a ring is called, and the captures by their error above the noise there."""
        return f"at {errors.frequency[0, place]:.2f} cycles/pixel", errors.worst_in_ring(place)


class _Brightness:
    """Error, noise and bias over the predicted counts."""

    title = "Over brightness"

    def __init__(self, visit: Visit) -> None:
        c = visit.colours
        self.figure = _plot(x_axis_label="predicted counts above black", y_axis_label="counts, rms")
        self.source = ColumnDataSource({k: [0.1, 1.0] for k in ("counts", "error", "noise", "bias")})
        for kind, colour, dash in (
            ("error", c["main"], "solid"),
            ("noise", c["other"], "dashed"),
            ("bias", c["third"], "dotted"),
        ):
            self.figure.line(
                "counts",
                kind,
                source=self.source,
                color=colour,
                line_dash=dash,
                line_width=2,
                legend_label=kind,
            )
        self.figure.scatter("counts", "error", source=self.source, color=c["main"], size=5)
        self.figure.legend.location = "top_left"

    def show(self, errors: SetErrors) -> None:
        """Draw."""
        counts, error, bias, noise, _ = errors.brightness
        some = np.isfinite(error)
        self.source.data = {
            "counts": counts[some],
            "error": error[some],
            "noise": noise[some],
            "bias": bias[some],
        }

    def place(self, errors: SetErrors, x: float, y: float) -> int | None:
        """The step at a place."""
        return int(np.argmin(np.abs(errors.brightness[0] - x)))

    def worst(self, errors: SetErrors, place: int) -> tuple[str, list[tuple[str, float]]]:
        """What a step is called, and the captures by their rms error there."""
        edges = errors.captures[0].edges
        return f"between {edges[place]:.0f} and {edges[place + 1]:.0f} counts", errors.worst_in_step(place)


class _Time:
    """Excess of each held-out capture over the time it was taken."""

    title = "Over time"

    def __init__(self, visit: Visit) -> None:
        self.figure = _plot(x_axis_label="time, s", y_axis_label="excess", y_range=Range1d(start=0, end=1))
        self.figure.yaxis.formatter = BasicTickFormatter(precision=1)
        self.source = ColumnDataSource({k: [0.1, 1.0] for k in ("time", "excess", "gain", "capture")})
        self.figure.line("time", "excess", source=self.source, color=visit.colours["quiet"], line_width=1)
        drawn = self.figure.scatter("time", "excess", source=self.source, color=visit.colours["main"], size=8)
        rows = [("capture", "@capture"), ("excess", "@excess{0.00000}"), ("gain", "@gain{0.0000}")]
        self.figure.add_tools(HoverTool(tooltips=rows, renderers=[drawn]))

    def show(self, errors: SetErrors) -> None:
        """Draw."""
        rows = errors.time()
        values = [r["excess"] for r in rows]
        low, high = min(0.0, *values), max(SMALL, *values)
        room = 0.08 * (high - low)
        self.figure.y_range.update(start=low - room, end=high + room)
        self.source.data = {
            "time": [r["time_s"] for r in rows],
            "excess": values,
            "gain": [np.nan if r["gain"] is None else r["gain"] for r in rows],
            "capture": [r["capture"] for r in rows],
        }

    def place(self, errors: SetErrors, x: float, y: float) -> float | None:
        """The time at a place."""
        return x

    def worst(self, errors: SetErrors, place: float) -> tuple[str, list[tuple[str, float]]]:
        """Captures by how near in time they were taken."""
        rows = sorted(errors.time(), key=lambda r: abs(r["time_s"] - place))
        return f"near {place:.3g} s", [(r["capture"], r["excess"]) for r in rows]
