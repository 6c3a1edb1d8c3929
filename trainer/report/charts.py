"""The charts of a report, as SVG with a text description."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from trainer.formatting import number, percent, plain, superscript
from trainer.report.chart_style import (
    CHART,
    INK,
    MAIN,
    OTHER,
    PAPER,
    QUIET,
    STYLE,
    THIRD,
    new_chart,
    svg,
)
from trainer.report.failure_plots import FailurePlot

MARKERS = ("o", "s", "^", "D", "v", "P", "X")
COLOURS = {"main": MAIN, "other": OTHER, "third": THIRD, "quiet": QUIET}
NARROW, WIDE = 5.2, 7.2  # inches, of a chart in a column and over the whole page


def failure_chart(plot: FailurePlot) -> Markup:
    """A plot of where the model fails."""
    with matplotlib.rc_context(STYLE):
        count = len(plot.panels)
        figure = Figure(figsize=(CHART[0], 3.0 + 0.3 * (count - 1)), layout="constrained")
        every = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
        for axes, panel in zip(every, plot.panels, strict=True):
            if panel.level is not None:
                axes.axhline(panel.level, color=QUIET, linewidth=0.8)
            for k, c in enumerate(panel.curves):
                marker = MARKERS[k % len(MARKERS)] if c.marked else None
                width = 1.2 if count > 1 else 2.0
                axes.plot(
                    c.x, c.y, color=COLOURS[c.colour], linestyle=c.dash, linewidth=width, marker=marker, markersize=4.5,
                    label=c.name,
                )  # fmt: skip
            axes.set_ylabel(panel.label)
            if panel.ends is None:
                axes.set_yscale("log")
                axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _power_of_ten(value)))
                axes.yaxis.set_minor_formatter(NullFormatter())
            else:
                axes.set_ylim(panel.ends)
                axes.yaxis.set_major_locator(MaxNLocator(4 if count > 1 else 6))
                axes.ticklabel_format(useOffset=False)
        every[-1].set_xlabel(plot.label)
        if len(plot.panels[0].curves) > 1:
            _legend_above(figure, every[0])
        return svg(figure, plot.alt)


def ladder_chart(labels: Sequence[str], nrmse: Sequence[float], noise: float | None) -> Markup:
    """Held-out error after each step, from top to bottom, with the noise floor drawn in."""
    y = np.arange(len(labels))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(NARROW, 1.15 + 0.34 * len(labels)), layout="constrained")
        axes = figure.subplots()
        low = min([*nrmse, *([noise] if noise else [])]) / 1.35
        if noise:
            axes.axvspan(low, noise, color=OTHER, alpha=0.14, linewidth=0)
            axes.axvline(noise, color=OTHER, linestyle="--", linewidth=1.5)
            axes.annotate(
                f"camera noise {percent(noise)}", (noise, 1.0), xycoords=("data", "axes fraction"),
                xytext=(4, 3), textcoords="offset points", color=OTHER,
            )  # fmt: skip
        axes.plot(nrmse, y, color=MAIN, linewidth=1.2, alpha=0.6)
        axes.plot(nrmse, y, color=MAIN, marker="o", markersize=7, linestyle="none")
        for value, row in zip(nrmse, y, strict=True):
            _label_right(axes, percent(value), (value, float(row)))
        axes.set_xscale("log")
        axes.set_xlim(low, max(nrmse) * 1.35)
        axes.set_ylim(len(labels) - 0.5, -0.5)
        axes.set_yticks(y, labels)
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
        _log_ticks(axes)
        axes.set_xlabel("held-out error, rms, of the signal's spread")
        steps = ", ".join(f"{a} {percent(v)}" for a, v in zip(labels, nrmse, strict=True))
        floor = f"; the camera's noise alone is {percent(noise)}" if noise else ""
        return svg(figure, f"Held-out error after each step: {steps}{floor}.")


def stage_bars(rows: Sequence[dict[str, Any]], total: float | None, chosen: str | None) -> Markup:
    """Excess that each stage's free-form probe removes, and the whole excess as the length to reach."""
    names = [str(r["stage"]) for r in rows]
    values = [float(r["excess_removed"]) for r in rows]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDE, 1.05 + 0.36 * len(rows)), layout="constrained")
        axes = figure.subplots()
        bars = axes.barh(names, values, height=0.6, color=[MAIN if n == chosen else QUIET for n in names])
        for bar, name in zip(bars, names, strict=True):
            bar.set_alpha(1.0 if name == chosen else 0.55)
        for k, value in enumerate(values):
            share = f" ({percent(value / total, 2)})" if total and total > 0 else ""
            _label_right(axes, number(value) + share, (max(value, 0.0), k))
        if total and total > 0:
            axes.axvline(total, color=INK, linewidth=1.2, linestyle="--")
            axes.annotate(
                f"all of the excess {number(total)}", (total, 1.0), xycoords=("data", "axes fraction"),
                xytext=(0, 3), textcoords="offset points", ha="right",
            )  # fmt: skip
        axes.axvline(0, color=QUIET, linewidth=1)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(min([0.0, *values]) * 1.1, max([*values, total or 0.0, 1e-9]) * 1.28)
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("excess removed on held-out captures by a free-form probe of that stage alone")
        said = ", ".join(f"{n} {number(v)}" for n, v in zip(names, values, strict=True))
        return svg(figure, f"Excess removed by each stage's probe: {said}.")


def forest_plot(rows: Sequence[Mapping[str, Any]], least: float | None) -> Markup:
    """Excess that each effect removes, with its interval; filled where it is worth adding."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(NARROW, 1.1 + 0.27 * len(rows)), layout="constrained")
        axes = figure.subplots()
        for k, r in enumerate(rows):
            low, high = r.get("ci95") or (r["excess_removed"], r["excess_removed"])
            worth = is_worth(r, least)
            colour = MAIN if worth else QUIET
            axes.plot([low, high], [k, k], color=colour, linewidth=2.2, solid_capstyle="butt")
            axes.plot(
                r["excess_removed"], k, marker="o", markersize=7, color=colour,
                markerfacecolor=colour if worth else PAPER, linestyle="none",
            )  # fmt: skip
        axes.axvline(0, color=INK, linewidth=1.2)
        if least:
            axes.axvline(least, color=OTHER, linewidth=1.2, linestyle="--")
            side, shift = ("right", -4) if least > 0.6 * axes.get_xlim()[1] else ("left", 4)
            axes.annotate(
                f"least worth adding {number(least, 2)}", (least, 1.0), xycoords=("data", "axes fraction"),
                xytext=(shift, 3), textcoords="offset points", ha=side, color=OTHER,
            )  # fmt: skip
        axes.set_yticks(range(len(rows)), [plain(r["effect"]) for r in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("held-out excess removed, 95 % interval")
        said = ", ".join(f"{r['effect']} {number(r['excess_removed'])}" for r in rows)
        return svg(figure, f"Excess removed by each effect with its interval, best first: {said}.")


def is_worth(row: Mapping[str, Any], least: float | None) -> bool:
    """Whether an effect of the ranking is worth adding: by the diagnosis, or else by its interval."""
    if "worth_adding" in row:
        return bool(row["worth_adding"])
    low, _ = row.get("ci95") or (0.0, 0.0)
    return bool(low > 0 and row["excess_removed"] > (least or 0.0))


def curve_chart(values: np.ndarray, title: str, unit: str) -> Markup:
    """A fitted probe that is a curve."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_chart((3.0, 2.3))
        axes.axhline(0, color=QUIET, linewidth=0.8)
        axes.plot(values, color=MAIN)
        axes.set_ylabel("" if unit == "1" else unit)
        axes.margins(x=0.01)
        text = f"Curve of {title}: {len(values)} points from {number(float(np.nanmin(values)))} to "
        return svg(figure, f"{text}{number(float(np.nanmax(values)))} {'' if unit == '1' else unit}.")


def _label_right(axes: Axes, text: str, place: tuple[float, float]) -> None:
    box = {"facecolor": PAPER, "edgecolor": "none", "pad": 1.0, "alpha": 0.85}
    axes.annotate(text, place, xytext=(8, 0), textcoords="offset points", va="center", bbox=box)


def _legend_above(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2, handlelength=1.8, columnspacing=1.2)


def _power_of_ten(value: float) -> str:
    return f"10{superscript(round(np.log10(value)))}" if value > 0 else ""


def _log_ticks(axes: Axes) -> None:
    axes.xaxis.set_major_locator(LogLocator(10, subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: percent(value, 1)))
    axes.xaxis.set_minor_formatter(NullFormatter())
