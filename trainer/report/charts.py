"""The charts of a report, as SVG with a text description."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from trainer.formatting import number, percent, superscript
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

MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def frequency_chart(rows: Sequence[dict[str, Any]]) -> Markup:
    """Power spectra of the error, of the expected noise and of the signal, logarithmic."""
    f = [r["cycles_per_pixel"] for r in rows]
    with matplotlib.rc_context(STYLE):
        figure, axes = new_chart()
        axes.fill_between(
            f, [r["noise"] for r in rows], [r["error"] for r in rows], color=MAIN, alpha=0.15, linewidth=0
        )
        axes.plot(f, [r["signal"] for r in rows], color=QUIET, linewidth=1.4, label="signal")
        axes.plot(f, [r["error"] for r in rows], color=MAIN, label="error")
        axes.plot(f, [r["noise"] for r in rows], color=OTHER, linestyle="--", label="camera noise, expected")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _power_of_ten(value)))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set(xlabel="spatial frequency, cycles/pixel", ylabel="power, counts²")
        axes.set_xlim(0, max(f, default=0.7))
        axes.legend(loc="upper right")
        top = max(float(r["signal"]) for r in rows)
        low = min([float(r[k]) for r in rows for k in ("error", "noise") if r[k] > 0] or [0.0])
        text = (
            f"Power of signal, error and expected noise over spatial frequency, from {number(low)} to "
            f"{number(top)} counts squared on a logarithmic scale; {frequency_words(rows)}"
        )
        return svg(figure, text)


def frequency_words(rows: Sequence[dict[str, Any]]) -> str:
    """Where over frequency the error above the noise lies, in a sentence."""
    f = np.array([r["cycles_per_pixel"] for r in rows])
    above = np.array([max(r["error"] - r["noise"], 0.0) for r in rows]) * f
    if above.sum() <= 0.02 * float(np.sum(f * [r["noise"] for r in rows])):
        return "the error follows the camera's noise at every frequency."
    half = f[int(np.searchsorted(np.cumsum(above), above.sum() / 2))]
    signal = np.array([r["signal"] for r in rows]) * f
    usual = f[int(np.searchsorted(np.cumsum(signal), signal.sum() / 2))]
    return (
        f"half of the error above the noise lies below {number(half, 2)} cycles/pixel "
        f"(half of the signal below {number(usual, 2)})."
    )


def brightness_chart(rows: Sequence[dict[str, Any]]) -> Markup:
    """Root mean squared error above the noise, the noise and the bias over the predicted counts."""
    x = [r["counts"] for r in rows]
    above = [max(r["error"], 0.0) ** 0.5 for r in rows]
    with matplotlib.rc_context(STYLE):
        figure, axes = new_chart()
        axes.axhline(0, color=QUIET, linewidth=0.8)
        axes.plot(x, above, color=MAIN, marker="o", markersize=3.5, label="model error, rms above noise")
        axes.plot(
            x, [r["noise"] ** 0.5 for r in rows], color=OTHER, linestyle="--", label="camera noise, expected"
        )
        axes.plot(
            x, [r["bias"] for r in rows], color=THIRD, linestyle=":", marker="s", markersize=3,
            label="bias: measured − predicted",
        )  # fmt: skip
        axes.set(xlabel="predicted counts above black", ylabel="counts")
        _legend_above(figure, axes)
        worst = max(rows, key=lambda r: abs(r["bias"]))
        text = (
            f"Error over brightness: model error of up to {number(max(above))} counts rms, camera noise from "
            f"{number(rows[0]['noise'] ** 0.5)} to {number(rows[-1]['noise'] ** 0.5)}, largest bias "
            f"{number(worst['bias'])} counts at {number(worst['counts'])} counts."
        )
        return svg(figure, text)


def time_chart(rows: Sequence[dict[str, Any]]) -> Markup:
    """Each capture's own gain and excess over the time it was taken."""
    channels = list(dict.fromkeys(r["channel"] for r in rows))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(CHART[0], 3.3), layout="constrained")
        upper, lower = figure.subplots(2, 1, sharex=True)
        for k, channel in enumerate(channels):
            own = [r for r in rows if r["channel"] == channel]
            t = [r["time_s"] for r in own]
            colour, marker = (MAIN, OTHER, THIRD)[k % 3], MARKERS[k % len(MARKERS)]
            gains = [np.nan if r["gain"] is None else r["gain"] for r in own]
            excess = [np.nan if r["excess"] is None else r["excess"] for r in own]
            for axes, values in ((upper, gains), (lower, excess)):
                axes.plot(t, values, color=colour, marker=marker, markersize=4.5, lw=1.2, label=channel)
        upper.axhline(1, color=QUIET, linewidth=1, linestyle="--")
        upper.set_ylabel("gain")
        lower.set(ylabel="excess", xlabel="time, s")
        lower.set_ylim(bottom=min(0.0, lower.get_ylim()[0]))
        for axes in (upper, lower):
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.ticklabel_format(useOffset=False)
        low, high = upper.get_ylim()
        if high - low < 0.02:  # a drift too small to matter must not fill the chart
            upper.set_ylim(min(low, 0.99), max(high, 1.01))
        if len(channels) > 1:
            _legend_above(figure, upper)
        return svg(figure, f"Gain and excess of each held-out capture over time: {time_words(rows)}")


def time_words(rows: Sequence[dict[str, Any]]) -> str:
    """How far the captures' own gains spread, in a sentence."""
    gains = [r["gain"] for r in rows if r["gain"] is not None]
    if not gains:
        return "no capture has a gain."
    if len(gains) == 1:
        return f"the only held-out capture has a gain of {number(gains[0], 4)}."
    return f"the captures' own gains run from {number(min(gains), 4)} to {number(max(gains), 4)}."


def ladder_chart(labels: Sequence[str], nrmse: Sequence[float], noise: float | None) -> Markup:
    """Held-out error after each step, from top to bottom, with the noise floor drawn in."""
    y = np.arange(len(labels))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 1.15 + 0.36 * len(labels)), layout="constrained")
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
        axes.set_xlabel("held-out error, rms, share of the signal's spread (logarithmic)")
        steps = ", ".join(f"{a} {percent(v)}" for a, v in zip(labels, nrmse, strict=True))
        floor = f"; the camera's noise alone is {percent(noise)}" if noise else ""
        return svg(figure, f"Held-out error after each step: {steps}{floor}.")


def stage_bars(rows: Sequence[dict[str, Any]], total: float | None, chosen: str | None) -> Markup:
    """Excess that each stage's free-form probe removes, and the whole excess as the length to reach."""
    names = [str(r["stage"]) for r in rows]
    values = [float(r["excess_removed"]) for r in rows]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 1.05 + 0.36 * len(rows)), layout="constrained")
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


def forest_plot(rows: Sequence[dict[str, Any]], least: float | None) -> Markup:
    """Excess that each effect removes, with its interval; filled where it is worth adding."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 1.1 + 0.3 * len(rows)), layout="constrained")
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
        axes.set_yticks(range(len(rows)), [str(r["effect"]) for r in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("excess removed on held-out captures, with 95 % interval")
        said = ", ".join(f"{r['effect']} {number(r['excess_removed'])}" for r in rows)
        return svg(figure, f"Excess removed by each effect with its interval, best first: {said}.")


def is_worth(row: dict[str, Any], least: float | None) -> bool:
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
