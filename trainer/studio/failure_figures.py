"""Where a model fails, drawn to be looked at closely and clicked on: the plots of `trainer.report.failure_plots`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import BasicTickFormatter, ColumnDataSource, HoverTool, LinearColorMapper, Range1d
from bokeh.models.annotations.geometry import Span
from bokeh.plotting import figure

from trainer.formatting import number
from trainer.report.failure_plots import (
    LITTLE_EXCESS,
    FailurePlot,
    PlotPanel,
    brightness_plot,
    frequency_plot,
    time_plot,
)
from trainer.report.palettes import ERROR, MISSING, palette

HEIGHT = 220  # CSS pixels, of the panels of a plot together
CELL = {"flex": "1 1 calc(50% - 14px)", "min-width": "min(100%, 240px)"}
PLOTS = {"frequency": frequency_plot, "brightness": brightness_plot, "time": time_plot}


class FieldFigure:
    """Excess over the picture, in tiles.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the camera.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        height, width = shape
        plot: Any = figure(
            x_range=Range1d(start=0, end=width), y_range=Range1d(start=height, end=0), tools="tap",
            toolbar_location=None, min_border=0, width=260, height=max(1, round(260 * height / width)),
            sizing_mode="scale_width",
        )  # fmt: skip
        plot.axis.visible = False
        plot.grid.visible = False
        self.figures = [plot]
        self._mapper: Any = LinearColorMapper(palette=list(palette(ERROR)), low=0, high=1, nan_color=MISSING)
        self._source = ColumnDataSource({"image": [np.zeros((2, 2))], "dw": [width], "dh": [height]})
        drawn = plot.image(
            "image", x=0, y=0, dw="dw", dh="dh", source=self._source, color_mapper=self._mapper
        )
        rows = [("excess", "@image{0.0000}"), ("row, column", "$y{0}, $x{0}")]
        plot.add_tools(HoverTool(tooltips=rows, renderers=[drawn]))
        self._title = pn.pane.HTML("", margin=0)
        pane = pn.pane.Bokeh(plot, sizing_mode="scale_width", margin=0)
        self.view = pn.Column(self._title, pane, styles=CELL, margin=0)

    def show(self, where: Mapping[str, Any]) -> None:
        """Draw the rows under `where` of `compare --json`."""
        field = np.array([[np.nan if v is None else v for v in row] for row in where["field"]])
        top = max(float(np.nanmax(field)) if np.isfinite(field).any() else 1.0, LITTLE_EXCESS)
        tile = where["tile_px"]
        self._mapper.update(low=0.0, high=top)
        self._title.object = f"<h3>Over the field, excess 0 to {number(top, 2)}</h3>"
        self._source.data = {"image": [field], "dw": [field.shape[1] * tile], "dh": [field.shape[0] * tile]}


class CurveFigures:
    """The panels of a plot, above each other.

    Parameters
    ----------
    plot : FailurePlot
        Later ones have as many curves.
    colours : mapping of str to str
        Of curves, by name.
    """

    def __init__(self, plot: FailurePlot, colours: Mapping[str, str]) -> None:
        self._colours = colours
        self._sources: list[ColumnDataSource] = []
        self.figures: list[Any] = []
        last = len(plot.panels) - 1
        for k, panel in enumerate(plot.panels):
            self.figures.append(self._panel(panel, plot.label if k == last else "", len(plot.panels)))
        panes = [pn.pane.Bokeh(one, sizing_mode="stretch_width", margin=0) for one in self.figures]
        self.view = pn.Column(pn.pane.HTML(f"<h3>{plot.title}</h3>", margin=0), *panes, styles=CELL, margin=0)
        self.show(plot)

    def _panel(self, panel: PlotPanel, label: str, count: int) -> Any:
        height = HEIGHT if count == 1 else round(HEIGHT / count) + (14 if label else -14)
        more: dict[str, Any] = (
            {"y_axis_type": "log"}
            if panel.ends is None
            else {"y_range": Range1d(start=panel.ends[0], end=panel.ends[1])}
        )
        plot: Any = figure(
            height=height, min_border=4, toolbar_location=None, tools="tap", sizing_mode="stretch_width",
            y_axis_label=panel.label, **more,
        )  # fmt: skip
        plot.xgrid.visible = False
        plot.xaxis.axis_label = label or None
        plot.xaxis.visible = bool(label)
        plot.yaxis.ticker.desired_num_ticks = 4 if count > 1 else 6
        if self.figures:
            plot.x_range = self.figures[0].x_range
        if panel.ends is not None:
            plot.yaxis.formatter = BasicTickFormatter(precision=3)
        if panel.level is not None:
            plot.add_layout(
                Span(location=panel.level, dimension="width", line_color=self._colours["quiet"], line_width=1)
            )
        for c in panel.curves:
            source = ColumnDataSource({"x": [], "y": []})
            self._sources.append(source)
            named = {"legend_label": c.name} if len(panel.curves) > 1 and not self.figures else {}
            style = {"color": self._colours[c.colour], "source": source}
            plot.line("x", "y", line_dash=c.dash, line_width=2 if count == 1 else 1, **style, **named)
            if c.marked:
                plot.scatter("x", "y", size=6, **style)
        if plot.legend:
            plot.add_layout(plot.legend[0], "above")
            plot.legend.update(orientation="horizontal", spacing=14)
        return plot

    def show(self, plot: FailurePlot) -> None:
        """Draw another plot of as many curves."""
        curves = [c for panel in plot.panels for c in panel.curves]
        for source, c in zip(self._sources, curves, strict=True):
            source.data = {"x": list(c.x), "y": list(c.y)}
        for one, panel in zip(self.figures, plot.panels, strict=True):
            if panel.ends is not None:
                one.y_range.update(start=panel.ends[0], end=panel.ends[1])

    def fits(self, plot: FailurePlot) -> bool:
        """Whether a plot has as many curves."""
        return len(self._sources) == sum(len(panel.curves) for panel in plot.panels)


class FailureFigures:
    """The four plots: over the field, over spatial frequency, over brightness, over time.

    Parameters
    ----------
    where : mapping
        The rows under `where` of `compare --json`.
    shape : (int, int)
        Rows and columns of the camera.
    colours : mapping of str to str
        Of curves, by name.

    Attributes
    ----------
    view : panel Viewable
    parts : dict of str to FieldFigure or CurveFigures
        By "field", "frequency", "brightness" and "time".
    """

    def __init__(self, where: Mapping[str, Any], shape: tuple[int, int], colours: Mapping[str, str]) -> None:
        self.parts: dict[str, Any] = {"field": FieldFigure(shape)}
        self.parts |= {
            kind: CurveFigures(make(where[kind]), colours) for kind, make in PLOTS.items() if where[kind]
        }
        self.parts["field"].show(where)
        self.view = pn.FlexBox(
            *(p.view for p in self.parts.values()), gap="14px", sizing_mode="stretch_width"
        )

    def show(self, where: Mapping[str, Any]) -> bool:
        """Draw other rows; False where they do not fit these plots."""
        made = {kind: make(where[kind]) for kind, make in PLOTS.items() if where[kind]}
        if set(made) != set(self.parts) - {"field"} or not all(
            self.parts[k].fits(p) for k, p in made.items()
        ):
            return False
        self.parts["field"].show(where)
        for kind, plot in made.items():
            self.parts[kind].show(plot)
        return True
