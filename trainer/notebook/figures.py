"""Figures of a comparison and of an explanation, for notebooks and files."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from trainer.diagnosis.comparison import CapturePicture
from trainer.formatting import change_of, percent
from trainer.report.palettes import DIFFERENCE, IRRADIANCE, palette


class NotebookFigure(Figure):
    """A matplotlib figure that any notebook shows, without pyplot or a magic command."""

    def _repr_png_(self) -> bytes:
        """The figure as PNG."""
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=110)
        return stream.getvalue()


def comparison_figure(pictures: Sequence[CapturePicture]) -> NotebookFigure:
    """The first picture of a comparison: measured, predicted, difference."""
    figure = NotebookFigure(figsize=(9.0, 2.6), layout="constrained")
    _draw_picture(figure.subplots(1, 3), pictures)
    return figure


def explanation_figure(
    ladder: Sequence[Mapping[str, Any]], noise: float, pictures: Sequence[CapturePicture]
) -> NotebookFigure:
    """The error after each step of a ladder, and the first picture of a comparison below it.

    Parameters
    ----------
    ladder : sequence of mappings
        Keys `added`, `removed` and `nrmse`.
    noise : float
        The nrmse of the camera's noise alone.
    pictures : sequence of CapturePicture
        Of the last model.

    Returns
    -------
    NotebookFigure
    """
    height = 1.2 + 0.34 * len(ladder)
    figure = NotebookFigure(figsize=(9.0, height + 2.6), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=(height, 2.6))
    _draw_ladder(figure.add_subplot(grid[0, :]), ladder, noise)
    _draw_picture([figure.add_subplot(grid[1, k]) for k in range(3)], pictures)
    return figure


def image_tag(figure: NotebookFigure, alt: str) -> str:
    """A figure as an <img> element that needs no other file."""
    data = base64.b64encode(figure._repr_png_()).decode("ascii")
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{data}">'


def _draw_ladder(axes: Axes, ladder: Sequence[Mapping[str, Any]], noise: float) -> None:
    labels = [change_of(s) or "start" for s in ladder]
    errors = [float(s["nrmse"]) for s in ladder]
    rows = np.arange(len(ladder))
    axes.plot(errors, rows, marker="o")
    for error, row in zip(errors, rows, strict=True):
        axes.annotate(percent(error), (error, float(row)), xytext=(8, 5), textcoords="offset points")
    if noise > 0:
        axes.axvline(noise, color="tab:orange", linestyle="--", label=f"camera noise {percent(noise)}")
        axes.legend(loc="lower right", frameon=False)
    axes.set_xscale("log")
    axes.set_xlim(min([*errors, noise or errors[0]]) / 1.5, max(errors) * 2)
    axes.set_yticks(rows, labels)
    axes.set_ylim(len(ladder) - 0.5, -0.5)
    axes.set_xlabel("error on held-out captures (nrmse)")


def _draw_picture(axes: Sequence[Axes], pictures: Sequence[CapturePicture]) -> None:
    if not pictures:
        for one in axes:
            one.set_axis_off()
        return
    picture = pictures[0]
    top = float(np.percentile(picture.measured, 99.8))
    spread = float(np.nanpercentile(np.abs(picture.difference), 99.7)) or 1.0
    shown = (
        (f"measured ({picture.channel}, {picture.plane_mm:g} mm)", picture.measured, 0.0, top, IRRADIANCE),
        ("predicted", picture.predicted, 0.0, top, IRRADIANCE),
        ("difference", picture.difference, -spread, spread, DIFFERENCE),
    )
    for one, (title, values, low, high, colours) in zip(axes, shown, strict=True):
        image = one.imshow(values, vmin=low, vmax=high, cmap=ListedColormap(palette(colours)))
        one.set_title(title, fontsize=9)
        one.set_xticks([])
        one.set_yticks([])
        one.figure.colorbar(image, ax=one, shrink=0.85)
