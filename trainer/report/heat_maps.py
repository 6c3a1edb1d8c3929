"""Arrays as heat maps in a page: a small palette PNG as a data URI, with ticks, a colour bar and a text description."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.ticker import MaxNLocator
from PIL import Image

from trainer.formatting import number
from trainer.report.png_uri import png_uri

IRRADIANCE = "viridis"
ERROR = "cividis"
DIFFERENCE = "RdBu_r"
MISSING = (128, 128, 128)
LEVELS = 255  # the last of 256 palette entries stands for "nothing measured"
LARGEST = 480  # pixels along a side; larger pictures are shown as means of blocks
BAR = 9  # stops of a colour bar


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
        Name of a matplotlib colour map.
    extent : (float, float, float, float) or None, pixels
        Top, left, height and width that the axes show; None: the array's own.
    largest : int, pixels
        Side above which the picture shows means of blocks.
    """
    top, left, height, width = extent or (0.0, 0.0, float(array.shape[0]), float(array.shape[1]))
    factor = -(-max(array.shape) // largest)
    small = blocks(array, factor)
    low, high = scale if scale[1] > scale[0] else (scale[0], scale[0] + 1)
    index = np.full(small.shape, LEVELS, dtype=np.uint8)
    finite = np.isfinite(small)
    index[finite] = np.clip(np.rint((small[finite] - low) / (high - low) * (LEVELS - 1)), 0, LEVELS - 1)
    words = [note] if note else []
    if factor > 1:
        words.append(f"each point is the mean of {factor} × {factor} pixels")
    return HeatMap(
        title,
        _png(index, colours),
        alt,
        width,
        height,
        _ticks(left, width),
        _ticks(top, height),
        _gradient(colours),
        (Tick(0, number(low)), Tick(50, number((low + high) / 2)), Tick(100, number(high))),
        unit,
        "; ".join(words),
    )


def blocks(array: np.ndarray, factor: int) -> np.ndarray:
    """Means over blocks of factor x factor pixels, without NaN; what is left at the border is cut off."""
    if factor <= 1:
        return array
    height, width = (n // factor * factor for n in array.shape)
    parts = array[:height, :width].reshape(height // factor, factor, width // factor, factor)
    finite = np.isfinite(parts)
    count = finite.sum((1, 3))
    total = np.where(finite, parts, 0).sum((1, 3), dtype=np.float64)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


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


def _png(index: np.ndarray, colours: str) -> str:
    palette = np.rint(matplotlib.colormaps[colours](np.linspace(0, 1, LEVELS))[:, :3] * 255).astype(np.uint8)
    picture = Image.fromarray(index)
    picture.putpalette(bytes(palette.tobytes()) + bytes(MISSING))
    return png_uri(picture)


def _ticks(start: float, length: float) -> tuple[Tick, ...]:
    values = MaxNLocator(4, integer=True, steps=[1, 2, 2.5, 5, 10]).tick_values(start, start + length)
    return tuple(
        Tick(float((v - start) / length * 100), f"{v:g}") for v in values if start <= v <= start + length
    )


def _gradient(colours: str) -> str:
    stops = matplotlib.colormaps[colours](np.linspace(0, 1, BAR))[:, :3]
    return ", ".join("#" + "".join(f"{round(255 * c):02x}" for c in stop) for stop in stops)
