"""Measured, predicted and difference of a capture: one scale, linked pan and zoom, values under the cursor, a wipe.

Large pictures are shown as means of blocks, and pixel by pixel where one has zoomed in.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import BoxZoomTool, ColumnDataSource, HoverTool, LinearColorMapper, Range1d
from bokeh.plotting import figure

from trainer.captures.block_means import blocks
from trainer.formatting import number
from trainer.report.palettes import DIFFERENCE, IRRADIANCE, MISSING, gradient, palette
from trainer.studio.job_tasks import CapturePrediction, block_side

NOTHING = np.zeros((2, 2), np.float32)
CLOSEST = 6  # pixels across, at the closest zoom
KINDS = ("measured", "predicted", "difference")
TITLES = {
    "measured": "Measured",
    "predicted": "Predicted",
    "difference": "Measured − predicted",
    "wipe": "Measured | predicted",
    "predicted_2": "Predicted by the other",
    "difference_2": "Measured − the other",
}


class LinkedPictures:
    """Pictures of one capture on common axes."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        height, width = shape
        self.x: Any
        self.y: Any
        self.x, self.y = (
            Range1d(start=0, end=width, bounds=(0, width), min_interval=CLOSEST),
            Range1d(start=height, end=0, bounds=(0, height), min_interval=CLOSEST),
        )
        self.light: Any = LinearColorMapper(
            palette=list(palette(IRRADIANCE)), low=0, high=1, nan_color=MISSING
        )
        self.apart: Any = LinearColorMapper(
            palette=list(palette(DIFFERENCE)), low=-1, high=1, nan_color=MISSING
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
            lod_timeout=20,  # ms after a zoom until finer pixels are asked for
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


def scales_html(pictures: LinkedPictures) -> str:
    """Colour bars: one for light, one for differences."""

    def bar(name: str, low: float, high: float, words: str) -> str:
        colours = f"<i style='background:linear-gradient(90deg,{gradient(name)})'></i>"
        ends = (f"<span>{number(v)}</span>" for v in (low, high))
        return f"<div class='scale'>{colours.join(ends)}<small>{words}</small></div>"

    light, apart = pictures.light, pictures.apart
    return (
        "<div class='scales'>"
        + bar(IRRADIANCE, light.low, light.high, "counts above black, measured and predicted")
        + bar(DIFFERENCE, apart.low, apart.high, "counts, difference")
        + "</div>"
    )
