"""The style of charts, and their SVG in the page itself: text and lines take the page's colours, light or dark."""

from __future__ import annotations

import hashlib
import io
import re
from typing import Any

from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Placeholders of the page's colours; each is replaced by a CSS value after drawing.
INK, QUIET, GRID, PAPER = "#010101", "#020202", "#030303", "#070707"
MAIN, OTHER, THIRD = "#040404", "#050505", "#060606"
CSS = {
    INK: "var(--ink)",
    QUIET: "var(--quiet)",
    GRID: "var(--line)",
    PAPER: "var(--paper)",
    MAIN: "var(--main)",
    OTHER: "var(--other)",
    THIRD: "var(--third)",
}
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "hololoop",
    "text.parse_math": False,
    "font.family": ["DejaVu Sans"],
    "font.size": 9.5,
    "text.color": INK,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 2.0,
    "legend.frameon": False,
    "legend.fontsize": 9,
}
CHART = (4.6, 3.0)  # inches


def new_chart(size: tuple[float, float] = CHART) -> tuple[Figure, Axes]:
    """An empty chart of a size in inches."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots()


def svg(figure: Figure, alt: str) -> Markup:
    """A figure as an <svg> element without links, whose ids are unique in the page."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'^<svg([^>]*?)\swidth="[^"]*"', r"<svg\1", text)
    text = re.sub(r'^<svg([^>]*?)\sheight="[^"]*"', r"<svg\1", text)
    for stand_in, css in CSS.items():
        text = text.replace(stand_in, css)
    used = set(re.findall(r'(?:url\(#|href="#)([\w-]+)', text))
    prefix = "c" + hashlib.sha256(text.encode()).hexdigest()[:8]
    text = re.sub(r'\sid="([\w.-]+)"', lambda m: f' id="{prefix}{m[1]}"' if m[1] in used else "", text)
    text = re.sub(r'(url\(#|href="#)([\w-]+)', rf"\g<1>{prefix}\g<2>", text)
    return Markup(text.replace("<svg", f'<svg role="img" aria-label="{escape(alt)}"', 1))
