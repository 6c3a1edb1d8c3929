"""Where a model fails, as descriptions of plots: what the report draws as SVG, the studio draws to be clicked on.

Each is made of the rows under `where` of `compare --json`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trainer.formatting import number

CHANNEL_COLOURS = ("main", "other", "third")
LITTLE_EXCESS, LITTLE_DRIFT = 5e-4, 0.01  # too little to matter, and so not to fill a plot
ROOM = 0.06  # of an axis' length, above and below its curves


@dataclass(frozen=True)
class Curve:
    """One curve.

    Attributes
    ----------
    name : str
    x, y : tuple of float
        NaN: nothing there.
    colour : str
        Of the page's colours: main, other, third or quiet.
    dash : str
        solid, dashed or dotted.
    marked : bool
        With a mark at each point.
    """

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    colour: str = "main"
    dash: str = "solid"
    marked: bool = False


@dataclass(frozen=True)
class PlotPanel:
    """Curves on common axes.

    Attributes
    ----------
    label : str
        Of the vertical axis.
    curves : tuple of Curve
    ends : (float, float) or None
        Of the vertical axis; None: logarithmic, as far as the curves reach.
    level : float or None
        Of a line to compare with.
    """

    label: str
    curves: tuple[Curve, ...]
    ends: tuple[float, float] | None
    level: float | None = None


@dataclass(frozen=True)
class FailurePlot:
    """Panels above each other, over one horizontal axis.

    Attributes
    ----------
    title, label : str
        Heading, and label of the horizontal axis.
    panels : tuple of PlotPanel
    words, alt : str
        What it says in a sentence, and a description of the picture.
    """

    title: str
    label: str
    panels: tuple[PlotPanel, ...]
    words: str
    alt: str


def frequency_plot(rows: Sequence[Mapping[str, Any]]) -> FailurePlot:
    """Power spectra of the signal, of the error and of the expected noise."""
    f = tuple(float(r["cycles_per_pixel"]) for r in rows)

    def curve(name: str, key: str, colour: str, dash: str = "solid") -> Curve:
        return Curve(name, f, tuple(float(r[key]) or np.nan for r in rows), colour, dash)

    panel = PlotPanel(
        "power, counts²",
        (
            curve("signal", "signal", "quiet"),
            curve("error", "error", "main"),
            curve("camera noise", "noise", "other", "dashed"),
        ),
        None,
    )
    top = max(float(r["signal"]) for r in rows)
    low = min([float(r[k]) for r in rows for k in ("error", "noise") if r[k] > 0] or [0.0])
    words = _frequency_words(rows)
    alt = (
        f"Power of signal, error and expected noise over spatial frequency, from {number(low)} to {number(top)} counts "
        f"squared on a logarithmic scale; {words}"
    )
    return FailurePlot("Over spatial frequency", "spatial frequency, cycles/pixel", (panel,), words, alt)


def _frequency_words(rows: Sequence[Mapping[str, Any]]) -> str:
    """Where over frequency the error above the noise lies."""
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


def brightness_plot(rows: Sequence[Mapping[str, Any]]) -> FailurePlot:
    """Root mean squared error above the noise, the noise, and the bias, over the predicted counts."""
    x = tuple(float(r["counts"]) for r in rows)
    above = tuple(max(float(r["error"]), 0.0) ** 0.5 for r in rows)
    noise = tuple(float(r["noise"]) ** 0.5 for r in rows)
    bias = tuple(float(r["bias"]) for r in rows)
    curves = (
        Curve("error above noise", x, above, "main", marked=True),
        Curve("camera noise", x, noise, "other", "dashed"),
        Curve("bias", x, bias, "third", "dotted"),
    )
    worst = max(rows, key=lambda r: abs(r["bias"]))
    words = f"largest bias {number(worst['bias'])} counts at {number(worst['counts'])} counts."
    alt = (
        f"Error over brightness: model error of up to {number(max(above))} counts rms, camera noise from "
        f"{number(noise[0])} to {number(noise[-1])}, {words}"
    )
    panel = PlotPanel("counts, rms; bias: mean", curves, _ends(curves, 0.0, 0.0), 0.0)
    return FailurePlot("Over brightness", "predicted counts above black", (panel,), words, alt)


def time_plot(rows: Sequence[Mapping[str, Any]]) -> FailurePlot:
    """Each capture's own gain and excess over the time it was taken, by colour."""
    colours = tuple(dict.fromkeys(str(r["channel"]) for r in rows))

    def curves(key: str) -> tuple[Curve, ...]:
        found = []
        for k, name in enumerate(colours):
            own = [r for r in rows if r["channel"] == name]
            y = tuple(np.nan if r[key] is None else float(r[key]) for r in own)
            x = tuple(float(r["time_s"]) for r in own)
            found.append(Curve(name, x, y, CHANNEL_COLOURS[k % len(CHANNEL_COLOURS)], marked=True))
        return tuple(found)

    gain, excess = curves("gain"), curves("excess")
    words = _time_words(rows)
    panels = (
        PlotPanel("gain", gain, _ends(gain, 1 - LITTLE_DRIFT, 1 + LITTLE_DRIFT), 1.0),
        PlotPanel("excess", excess, _ends(excess, 0.0, LITTLE_EXCESS)),
    )
    alt = f"Gain and excess of each held-out capture over time: {words}"
    return FailurePlot("Over time", "time, s", panels, words, alt)


def _time_words(rows: Sequence[Mapping[str, Any]]) -> str:
    """How far the captures' own gains spread."""
    gains = [r["gain"] for r in rows if r["gain"] is not None]
    if not gains:
        return "no capture has a gain."
    if len(gains) == 1:
        return f"the only held-out capture has a gain of {number(gains[0], 4)}."
    return f"the captures' own gains run from {number(min(gains), 4)} to {number(max(gains), 4)}."


def _ends(curves: Sequence[Curve], low: float, high: float) -> tuple[float, float]:
    """Ends of an axis that holds curves, and two values in any case."""
    values = [v for c in curves for v in c.y if np.isfinite(v)]
    low, high = min([low, *values]), max([high, *values])
    room = ROOM * ((high - low) or 1.0)
    return low - room, high + room
