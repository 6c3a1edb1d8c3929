"""Where the model fails, live: a click on a place, a band, a brightness or a time lists the captures worst there."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Tap

from trainer.diagnosis.capture_errors import SetErrors
from trainer.formatting import number
from trainer.studio.failure_figures import FailureFigures
from trainer.studio.project import Project
from trainer.studio.visit import Visit

MOST = 5
EVERYTHING = "over everything"
Worst = tuple[str, list[tuple[str, float]]]  # what a place is called, and captures with their error there


def failures_view(project: Project, visit: Visit) -> Any:
    """Four plots on the held-out captures, and the captures that are worst where one has clicked."""
    if project.set.captures is None:
        return pn.Column()
    shape = project.set.captures.bench.camera.shape
    drawn: list[FailureFigures] = []
    places: dict[str, Callable[[SetErrors], Worst]] = {}
    plots = pn.Column(sizing_mode="stretch_width", margin=0)
    words = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    worst = pn.FlexBox(gap="6px")
    where = pn.widgets.Select(name="Worst captures", options=[EVERYTHING], width=260, margin=0)

    def chosen(found: Worst) -> None:
        title, captures = found
        buttons = []
        for name, value in captures[:MOST]:
            button = pn.widgets.Button(
                name=f"{name}: {number(value, 2)}", css_classes=["plain-button"], margin=0
            )
            button.on_click(partial(_look_at, visit, name))
            buttons.append(button)
        worst[:] = buttons  # before the words: who reads them can click
        words.object = f"<p class='small'>Worst {escape(title)} (click one to see it):</p>"

    def pick(event: Any) -> None:
        errors = project.set.errors
        if errors is not None:
            chosen(places.get(event.new, _everything)(errors))

    def tapped(kind: str, event: Any) -> None:
        errors = project.set.errors
        found = None if errors is None else WORST_AT[kind](errors, event.x, event.y)
        if found is not None:
            chosen(found)

    def show() -> None:
        errors = project.set.errors
        if errors is None:
            words.object = "<p class='quiet'>Comparing with the held-out captures …</p>"
            worst[:] = []
            return
        if not drawn or not drawn[0].show(errors.where()):
            drawn[:] = [FailureFigures(errors.where(), shape, visit.colours)]
            for kind, part in drawn[0].parts.items():
                for one in part.figures:
                    one.on_event(Tap, partial(tapped, kind))
            plots[:] = [drawn[0].view]
        places.clear()
        places.update(_places(errors))
        where.param.update(options=[EVERYTHING, *places], value=EVERYTHING)
        chosen(_everything(errors))

    where.param.watch(pick, "value")
    visit.on("errors model", show)
    return pn.Column(
        pn.pane.HTML("<h2>Where the model fails</h2>", margin=0),
        plots,
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


def _everything(errors: SetErrors) -> Worst:
    captures = ((one.capture, one.errors.excess) for one in errors.captures)
    return EVERYTHING, sorted(captures, key=lambda pair: -pair[1])


def _at_pixel(errors: SetErrors, x: float, y: float) -> Worst | None:
    tile, (rows, columns) = errors.captures[0].tile_px, errors.field.shape
    row, column = int(y // tile), int(x // tile)
    return _in_tile(row, column, errors) if 0 <= row < rows and 0 <= column < columns else None


def _in_tile(row: int, column: int, errors: SetErrors) -> Worst:
    tile = errors.captures[0].tile_px
    y, x = (int((k + 0.5) * tile) for k in (row, column))
    return f"around row {y}, column {x}", errors.worst_at(row, column)


def _at_frequency(errors: SetErrors, x: float, y: float) -> Worst:
    return _in_ring(int(np.argmin(np.abs(errors.frequency[0] - x))), errors)


def _in_ring(ring: int, errors: SetErrors) -> Worst:
    return f"at {errors.frequency[0, ring]:.2f} cycles/pixel", errors.worst_in_ring(ring)


def _at_brightness(errors: SetErrors, x: float, y: float) -> Worst:
    return _in_step(int(np.argmin(np.abs(errors.brightness[0] - x))), errors)


def _in_step(step: int, errors: SetErrors) -> Worst:
    edges = errors.captures[0].edges
    return f"between {edges[step]:.0f} and {edges[step + 1]:.0f} counts", errors.worst_in_step(step)


def _at_time(errors: SetErrors, x: float, y: float) -> Worst:
    rows = sorted(errors.time(), key=lambda r: abs(r["time_s"] - x))
    return f"near {x:.3g} s", [(r["capture"], r["excess"]) for r in rows]


WORST_AT: dict[str, Callable[[SetErrors, float, float], Worst | None]] = {
    "field": _at_pixel,
    "frequency": _at_frequency,
    "brightness": _at_brightness,
    "time": _at_time,
}


def _places(errors: SetErrors) -> dict[str, Callable[[SetErrors], Worst]]:
    """Places to choose without a mouse, by what they are called."""
    field = np.nan_to_num(errors.field, nan=-1)
    finders: list[Callable[[SetErrors], Worst]] = []
    for flat in np.argsort(field, axis=None)[::-1][:3]:
        row, column = (int(k) for k in np.unravel_index(flat, field.shape))
        finders.append(partial(_in_tile, row, column))
    rings = errors.frequency.shape[1]
    finders += [partial(_in_ring, ring) for ring in range(1, rings, max(1, rings // 5))]
    finders += [partial(_in_step, step) for step in range(1, errors.brightness.shape[1], 4)]
    return {finder(errors)[0]: finder for finder in finders}
