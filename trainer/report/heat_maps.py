"""Arrays as heat maps in a page: a small palette PNG as a data URI, with ticks, a colour bar and a text description."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator
from PIL import Image

from trainer.captures.block_means import blocks
from trainer.formatting import number
from trainer.report.palettes import LEVELS, MISSING, gradient, palette
from trainer.report.png_uri import png_uri

LARGEST = 480  # pixels along a side; larger pictures are shown as means of blocks
FIGURE = Markup(
    '<figure class="map"><b>{title}</b><div class="frame"><div class="y" aria-hidden="true">{y}</div>'
    '<img src="{uri}" alt="{alt}" style="aspect-ratio:{width}/{height}"><div></div>'
    '<div class="x" aria-hidden="true">{x}</div><div class="bar" aria-hidden="true">'
    '<i style="background:linear-gradient(90deg,{bar})"></i><div class="scale-ends">{scale}</div></div>{unit}</div>'
    "{note}</figure>"
)


@dataclass(frozen=True)
class Tick:
    """A label on an axis.

    Attributes
    ----------
    at : float, per cent
        Of the axis' length.
    text : str
        The label.
    """

    at: float
    text: str


@dataclass(frozen=True)
class HeatMap:
    """A picture with its axes.

    Attributes
    ----------
    title, alt, note : str
        Heading, text description and caption.
    uri : str
        The PNG as a data URI.
    width, height : float, pixels
        Of the array.
    x, y, scale : tuple of Tick
        Of the axes and of the colour bar.
    bar : str
        CSS gradient of the colour bar.
    unit : str
        Of the values.
    """

    title: str
    uri: str
    alt: str
    width: float
    height: float
    x: tuple[Tick, ...]
    y: tuple[Tick, ...]
    bar: str
    scale: tuple[Tick, ...]
    unit: str
    note: str = ""

    def html(self) -> Markup:
        """A <figure> with title, axes, colour bar and caption."""
        return FIGURE.format(
            title=self.title,
            uri=self.uri,
            alt=self.alt,
            width=self.width,
            height=self.height,
            x=_labels(self.x, "left"),
            y=_labels(self.y, "top"),
            bar=self.bar,
            scale=_labels(self.scale, "left"),
            unit=_about(self.unit, "div", "unit"),
            note=_about(self.note, "figcaption", ""),
        )


def heat_map(
    title: str,
    array: np.ndarray,
    alt: str,
    unit: str,
    scale: tuple[float, float],
    colours: str,
    extent: tuple[float, float, float, float] | None = None,
    largest: int = LARGEST,
    note: str = "",
) -> HeatMap:
    """A picture of an array; NaN is gray.

    Parameters
    ----------
    title, alt, unit, note : str
        As of `HeatMap`.
    array : array [H, W]
        Values.
    scale : (float, float)
        Values at the two ends of the colour bar; values beyond are drawn as the ends.
    colours : str
        Name of a palette.
    extent : (float, float, float, float) or None, pixels
        Top, left, height and width that the axes show; None: the array's own.
    largest : int, pixels
        Side above which the picture shows means of blocks.
    """
    top, left, height, width = extent or (0.0, 0.0, float(array.shape[0]), float(array.shape[1]))
    factor = -(-max(array.shape) // largest)
    small = blocks(array, factor)
    low, high = scale if scale[1] > scale[0] else (scale[0], scale[0] + 1)
    words = [note] if note else []
    if factor > 1:
        words.append(f"each point is the mean of {factor} × {factor} pixels")
    return HeatMap(
        title,
        picture_uri(small, (low, high), colours),
        alt,
        width,
        height,
        _ticks(left, width),
        _ticks(top, height),
        gradient(colours),
        (Tick(0, number(low)), Tick(50, number((low + high) / 2)), Tick(100, number(high))),
        unit,
        "; ".join(words),
    )


def picture_uri(values: np.ndarray, scale: tuple[float, float], colours: str) -> str:
    """A small palette PNG of an array as a data URI; NaN is gray, values beyond the scale are drawn as its ends."""
    low, high = scale if scale[1] > scale[0] else (scale[0], scale[0] + 1)
    index = np.full(values.shape, LEVELS, dtype=np.uint8)  # the last of 256 entries: nothing measured
    finite = np.isfinite(values)
    index[finite] = np.clip(np.rint((values[finite] - low) / (high - low) * (LEVELS - 1)), 0, LEVELS - 1)
    picture = Image.fromarray(index)
    picture.putpalette([int(c[k : k + 2], 16) for c in (*palette(colours), MISSING) for k in (1, 3, 5)])
    return png_uri(picture)


def place(y: float, x: float) -> str:
    """A place in words, from its shares of height and width."""
    rows, columns = ("upper ", "", "lower "), ("left", "centre", "right")
    row, column = min(int(y * 3), 2), min(int(x * 3), 2)
    if row == column == 1:
        return "centre"
    if column == 1:
        return ("top", "", "bottom")[row] + " centre"
    return rows[row] + columns[column]


def symmetric(arrays: list[np.ndarray], share: float = 99.7) -> tuple[float, float]:
    """A scale about zero that holds all but a few values."""
    values = np.concatenate([np.abs(a[np.isfinite(a)]).ravel() for a in arrays])
    top = float(np.percentile(values, share)) if values.size else 1.0
    top = top or float(values.max(initial=0.0)) or 1.0
    return -top, top


def from_zero(arrays: list[np.ndarray], share: float = 99.8) -> tuple[float, float]:
    """A scale from zero that holds all but a few values."""
    values = np.concatenate([a[np.isfinite(a)].ravel() for a in arrays])
    return 0.0, (float(np.percentile(values, share)) if values.size else 1.0) or 1.0


def _ticks(start: float, length: float) -> tuple[Tick, ...]:
    values = MaxNLocator(4, integer=True, steps=[1, 2, 2.5, 5, 10]).tick_values(start, start + length)
    return tuple(
        Tick(float((v - start) / length * 100), f"{v:g}") for v in values if start <= v <= start + length
    )


def _labels(ticks: tuple[Tick, ...], side: str) -> Markup:
    one = Markup('<span style="{side}:{at:.2f}%">{text}</span>')
    return Markup("").join(one.format(side=side, at=t.at, text=t.text) for t in ticks)


def _about(text: str, tag: str, kind: str) -> Markup:
    """An element with a text; nothing without one."""
    if not text:
        return Markup("")
    return Markup('<{tag} class="{kind}">{text}</{tag}>').format(tag=tag, kind=kind, text=text)
