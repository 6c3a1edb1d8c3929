"""Charts of a fleet's page, as SVG with a text description."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from trainer.fleet.drift import Departures, DriftPair
from trainer.fleet.fleet_words import label, two_places
from trainer.formatting import plain
from trainer.report.chart_style import INK, MAIN, OTHER, PAPER, QUIET, STYLE, THIRD, new_chart, svg

WIDE = 7.2  # inches
LINES = (MAIN, OTHER, THIRD, QUIET)


def pairs_chart(pairs: Sequence[DriftPair]) -> Markup:
    """The correlation of each pair of effects with its interval; filled where they drift together."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDE, 1.0 + 0.32 * len(pairs)), layout="constrained")
        axes = figure.subplots()
        for k, pair in enumerate(pairs):
            colour = MAIN if pair.together else QUIET
            axes.plot(
                [-pair.by_error, pair.by_error],
                [k, k],
                color=OTHER,
                linewidth=8,
                alpha=0.25,
                solid_capstyle="butt",
            )
            axes.plot(pair.ci95, [k, k], color=colour, linewidth=2.2, solid_capstyle="butt")
            axes.plot(
                pair.correlation, k, marker="o", markersize=7, color=colour,
                markerfacecolor=colour if pair.together else PAPER, linestyle="none",
            )  # fmt: skip
        axes.axvline(0, color=INK, linewidth=1.2)
        axes.set_xlim(-1.03, 1.03)
        axes.set_yticks(range(len(pairs)), [" and ".join(plain(e) for e in p.effects) for p in pairs])
        axes.set_ylim(len(pairs) - 0.5, -0.5)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("rank correlation, 95 % interval")
        said = ", ".join(f"{' and '.join(p.effects)} {two_places(p.correlation)}" for p in pairs)
        return svg(
            figure, f"Rank correlation of each two effects with its interval, the surest first: {said}."
        )


def pair_chart(pair: DriftPair) -> Markup:
    """One number against the other, a point for each headset or set, with the fits' standard errors."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_chart((3.5, 3.0))
        one, other = pair.first, pair.second
        axes.errorbar(
            one.values, other.values, xerr=np.nan_to_num(one.errors), yerr=np.nan_to_num(other.errors),
            linestyle="none", marker="o", markersize=4.5, color=MAIN, ecolor=QUIET, elinewidth=0.8,
            alpha=0.85 if len(one.values) < 80 else 0.5,
        )  # fmt: skip
        axes.set_xlabel(label(one.number))
        axes.set_ylabel(label(other.number))
        axes.ticklabel_format(useOffset=False)
        what = "headsets" if one.over == "headsets" else "sets, from their headset's mean"
        text = f"{label(one.number)} against {label(other.number)}: {len(one.values)} {what}, "
        return svg(figure, f"{text}rank correlation {two_places(pair.correlation)}.")


def time_chart(pair: DriftPair, times: Mapping[str, datetime | None]) -> Markup | None:
    """Both numbers of a pair over time, from each headset's mean, a line for each headset; None without times.

    Parameters
    ----------
    times : mapping
        When each folder's captures were taken.
    """
    if pair.first.over != "time" or any(times.get(folder) is None for _, folder in pair.first.labels):
        return None
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDE, 4.2), layout="constrained")
        every = figure.subplots(2, 1, sharex=True)
        for axes, one in zip(every, (pair.first, pair.second), strict=True):
            _lines(axes, one, times)
            axes.set_ylabel(label(one.number), fontsize=8.5)
        locator = AutoDateLocator(maxticks=8)
        every[1].xaxis.set_major_locator(locator)
        every[1].xaxis.set_major_formatter(ConciseDateFormatter(locator))
        headsets = len({headset for headset, _ in pair.first.labels})
        names = " and ".join(label(d.number) for d in (pair.first, pair.second))
        return svg(
            figure, f"{names} over time, from the mean of each of {headsets} headsets, a line for each."
        )


def _lines(axes: Axes, one: Departures, times: Mapping[str, datetime | None]) -> None:
    axes.axhline(0, color=INK, linewidth=0.8)
    headsets = list(dict.fromkeys(headset for headset, _ in one.labels))
    for k, headset in enumerate(headsets):
        rows = [j for j, (name, _) in enumerate(one.labels) if name == headset]
        rows.sort(key=lambda j: str(times[one.labels[j][1]]))
        axes.plot(
            [times[one.labels[j][1]] for j in rows], one.values[rows],  # type: ignore[arg-type]
            color=LINES[k % len(LINES)], linewidth=1.1, marker="o", markersize=3.5, alpha=0.8,
        )  # fmt: skip
    axes.ticklabel_format(axis="y", useOffset=False)


def effects_chart(counts: Sequence[tuple[str, int]], sets: int) -> Markup:
    """In how many sets' models each effect is."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDE, 0.9 + 0.3 * len(counts)), layout="constrained")
        axes = figure.subplots()
        axes.barh([plain(name) for name, _ in counts], [count for _, count in counts], height=0.6, color=MAIN)
        for k, (_, count) in enumerate(counts):
            axes.annotate(str(count), (count, k), xytext=(6, 0), textcoords="offset points", va="center")
        axes.set_ylim(len(counts) - 0.5, -0.5)
        axes.set_xlim(0, sets * 1.08)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
        axes.set_xlabel(f"sets whose model has the effect, of {sets} that are finished")
        said = ", ".join(f"{name} {count}" for name, count in counts)
        return svg(figure, f"Sets whose model has each effect, of {sets}: {said}.")
