"""Which frequencies of an axis pass the iris, and where they lie on the panel's and on the image's DFT."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Run:
    """Frequencies that are consecutive in the panel's DFT, in the band and in the image's DFT, as slices.

    Attributes
    ----------
    panel, band, image : slice
        Where they are in each.
    again : bool
        An earlier run has read the same part of the panel's DFT, which is periodic.
    """

    panel: slice
    band: slice
    image: slice
    again: bool


@dataclass(frozen=True)
class Band:
    """One axis of the band.

    Attributes
    ----------
    frequencies : int array [n]
        DFT indices, those from 0 on first.
    runs : tuple of Run
    panel_gap, image_gap : slice
        The part of either DFT that the band leaves out.
    """

    frequencies: np.ndarray
    runs: tuple[Run, ...]
    panel_gap: slice
    image_gap: slice


def band(edge: int, panel_period: int, image_period: int) -> Band:
    """The frequencies -edge .. edge; where the image's DFT has fewer, each of its own once (see `folded`)."""
    count = min(2 * edge + 1, image_period)
    negative = count // 2 if count == image_period else edge
    frequencies = np.concatenate((np.arange(count - negative), np.arange(-negative, 0)))
    places = [(int(k) % panel_period, int(k) % image_period) for k in frequencies]
    used: set[int] = set()
    runs: list[Run] = []
    start = 0
    for i in range(1, count + 1):
        here, before = places[i] if i < count else (-1, -1), places[i - 1]
        again = places[start][0] in used
        joined = here[0] == before[0] + 1 and here[1] == before[1] + 1 and (here[0] in used) == again
        if not joined:
            (panel, image), length = places[start], i - start
            runs.append(
                Run(slice(panel, panel + length), slice(start, i), slice(image, image + length), again)
            )
            used.update(p for p, _ in places[start:i])
            start = i
    gaps = (slice(count - negative, max(n - negative, 0)) for n in (panel_period, image_period))
    return Band(frequencies, tuple(runs), *gaps)


def folded(transfer: np.ndarray, axis: int, edge: int, to: Band) -> np.ndarray:
    """A transfer function over -edge .. edge, in the order of a band; what it lacks is added where it aliases."""
    moved = np.moveaxis(transfer, axis, 0)
    period = len(to.frequencies)
    result = np.zeros((period, *moved.shape[1:]), moved.dtype)
    place = np.arange(-edge, edge + 1) % period
    if period == len(place):
        result[place] = moved
    else:
        np.add.at(result, place, moved)
    return np.moveaxis(result, 0, axis)
