"""Three linked pictures of an effect: ideal, with it, and the difference, with their colour bars."""

from __future__ import annotations

import math
from html import escape
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import (
    ColumnDataSource,
    CrosshairTool,
    HoverTool,
    LinearColorMapper,
    PanTool,
    Range1d,
    ResetTool,
    WheelZoomTool,
)
from bokeh.models.annotations.geometry import Span
from bokeh.models.widgets.markups import Div
from bokeh.plotting import figure

from trainer.report.palettes import DIFFERENCE, IRRADIANCE, gradient, palette
from trainer.studio.effect_demonstration import EffectPicture

LINE = "#8a8f98"  # of frames and cross-hairs: seen on light and on dark
NARROWEST, GAP = 220, 16  # of a picture and between two, CSS pixels
SHARE = 99.0  # per cent of the pixels that the difference's colours hold


class EffectPictures:
    """Ideal, with the effect, and the difference, side by side where there is room.

    Attributes
    ----------
    view : panel Viewable
    """

    def __init__(self, first: EffectPicture) -> None:
        height, width = first.ideal.shape
        # The ideal picture never changes, and is sent once.
        self._ideal = ColumnDataSource(data={"ideal": [first.ideal]})
        self._source = ColumnDataSource(data=_columns(first))
        self._top = _round_up(float(np.percentile(first.ideal, 99.8)))
        self._spread = 1.0
        self._difference = LinearColorMapper(palette=list(palette(DIFFERENCE)), low=-1, high=1)
        irradiance = LinearColorMapper(palette=list(palette(IRRADIANCE)), low=0, high=self._top)
        self._x, self._y = Range1d(start=0, end=width), Range1d(start=height, end=0)
        self._whole = (width, height)
        across, down = Span(dimension="width", line_color=LINE), Span(dimension="height", line_color=LINE)
        plots = []
        for name, mapper in (
            ("ideal", irradiance),
            ("with_effect", irradiance),
            ("difference", self._difference),
        ):
            plots.append(self._plot(name, mapper, (across, down)))
        self._with_title = _html("")
        # Bokeh's own text: while a slider moves, a new one of Panel's would have the page laid out again.
        self._difference_bar = Div(sizing_mode="stretch_width", stylesheets=[_STYLE], margin=0)
        pictures = [
            pn.Column(_html(_title("Ideal")), plots[0], styles=_flex(NARROWEST, 1)),
            pn.Column(self._with_title, plots[1], styles=_flex(NARROWEST, 1)),
        ]
        pair = pn.Column(
            pn.FlexBox(*pictures, flex_wrap="wrap", gap=f"{GAP}px", sizing_mode="stretch_width"),
            _html(_bar(IRRADIANCE, ("0", f"{self._top / 2:g}", f"{self._top:g}"), "counts above black")),
            styles=_flex(2 * NARROWEST + GAP, 2),
        )
        difference = pn.Column(
            _html(_title("Difference", "with the effect less ideal")),
            plots[2],
            pn.pane.Bokeh(self._difference_bar, sizing_mode="stretch_width", margin=0),
            styles=_flex(NARROWEST, 1),
        )
        self.view = pn.FlexBox(
            pair, difference, flex_wrap="wrap", gap=f"{GAP}px", sizing_mode="stretch_width"
        )

    def name(self, effect: str) -> None:
        """Write the effect's name over its picture, and let the difference's colours start anew."""
        self._with_title.object = _title(f"With {effect}")
        self._spread = 0.0

    def draw(self, picture: EffectPicture) -> None:
        """Draw other pictures; the difference's scale grows where it must, so that movement is not scaled away."""
        spread = float(np.percentile(np.abs(picture.difference), SHARE))
        if spread > self._spread:
            self._spread = _round_up(max(spread, 1.0))
            self._difference.update(low=-self._spread, high=self._spread)
            ends = (f"−{self._spread:g}", "0", f"+{self._spread:g}")
            self._difference_bar.text = _bar(DIFFERENCE, ends, "counts")
        self._source.data = _columns(picture)

    def show_whole(self) -> None:
        """Undo pan and zoom."""
        width, height = self._whole
        self._x.update(start=0, end=width)
        self._y.update(start=height, end=0)

    def _plot(self, name: str, mapper: LinearColorMapper, cross: tuple[Span, Span]) -> pn.pane.Bokeh:
        width, height = self._whole
        plot = figure(
            x_range=self._x,
            y_range=self._y,
            tools=[
                PanTool(),
                WheelZoomTool(modifiers={"shift": True}),
                ResetTool(),
                CrosshairTool(overlay=cross),
            ],
            toolbar_location=None,
            width=2 * width,
            height=2 * height,
            sizing_mode="scale_width",
            min_border=0,
            background_fill_color=None,
            border_fill_color=None,
            outline_line_color=LINE,
        )
        plot.axis.visible = False
        plot.grid.visible = False
        plot.image(  # type: ignore[call-arg]
            image=name,
            source=self._ideal if name == "ideal" else self._source,
            x=0,
            y=0,
            dw=width,
            dh=height,
            color_mapper=mapper,
            name=name,
        )
        rows = [("row, column", "$y{0}, $x{0}"), (name.replace("_", " "), "@" + name + "{0,0}")]
        plot.add_tools(HoverTool(tooltips=rows))
        return pn.pane.Bokeh(plot, sizing_mode="scale_width", margin=0)


def _columns(picture: EffectPicture) -> dict[str, list[Any]]:
    return {
        "with_effect": [picture.with_effect],
        "difference": [picture.difference],
    }


def _flex(basis: int, grow: int) -> dict[str, str]:
    return {"flex": f"{grow} 1 {basis}px", "min-width": "0", "margin": "0"}


def _html(text: str) -> pn.pane.HTML:
    return pn.pane.HTML(text, sizing_mode="stretch_width", margin=0, stylesheets=[_STYLE])


def _title(text: str, note: str = "") -> str:
    return f"<h3>{escape(text)} <small>{escape(note)}</small></h3>"


def _bar(colours: str, ends: tuple[str, str, str], unit: str) -> str:
    """A colour bar with three labels."""
    low, middle, high = (escape(e) for e in ends)
    return (
        f'<div class="bar" role="img" aria-label="Colours from {low} to {high} {unit}">'
        f'<div class="colours" style="background: linear-gradient(to right, {gradient(colours)})"></div>'
        f'<div class="ends"><span>{low}</span><span>{middle} {escape(unit)}</span><span>{high}</span></div></div>'
    )


def _round_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 5 and 7 times a power of ten."""
    power = 10 ** math.floor(math.log10(value))
    return next((s * power for s in (1, 1.5, 2, 3, 5, 7) if s * power >= value), 10 * power)


_STYLE = """
.bk-clearfix { display: block; width: 100%; }
h3 { font-size: 0.95rem; font-weight: 600; margin: 0 0 6px; }
h3 small { font-weight: 400; opacity: 0.75; }
.bar { margin-top: 8px; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
.colours { height: 10px; border-radius: 2px; outline: 1px solid #8a8f9866; }
.ends { display: flex; justify-content: space-between; margin-top: 2px; }
.ends span { flex: 1 1 0; text-align: center; white-space: nowrap; }
.ends span:first-child { text-align: left; }
.ends span:last-child { text-align: right; }
"""
