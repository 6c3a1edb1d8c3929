"""What captures say of each number of an estimate: the Fisher information matrix of a fit, from a sample of the pixels.

Speckle is alike everywhere, from pattern to pattern, and however far an estimate is from the truth. So some hundred
thousand pixels tell what all would, to a few per cent, and one matrix serves fit after fit. It only makes the numbers
of a fit alike; what is fitted depends on the slopes, which come from every pixel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.calibration.columns import Columns
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, gain_of
from runtime.calibration.parameter_layout import ParameterLayout
from runtime.program.progress import Progress

SAMPLE = 250_000  # pixels of a colour: thousands for each number
BLOCK = 1 << 17  # pixels that are multiplied at a time, in double precision


@dataclass(frozen=True)
class Information:
    """A Fisher information matrix.

    Attributes
    ----------
    layout : ParameterLayout
        What its rows and columns are.
    matrix : float64 array [n, n]
        A capture's, on the average over the colours' captures.
    """

    layout: ParameterLayout
    matrix: np.ndarray

    def of(self, layout: ParameterLayout) -> np.ndarray:
        """The matrix of another layout, of the same orders or lower."""
        places = self.layout.places_of(layout)
        return self.matrix[np.ix_(places, places)]


def measured_information(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    estimate: Estimate,
    layout: ParameterLayout,
    progress: Progress,
) -> Information:
    """The information that a capture has at an estimate.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    shots : sequence of Shot
    estimate : Estimate
        Of the layout's orders.
    layout : ParameterLayout
    progress : callable
        Called with the share done, 0 to 1.
    """
    count = int(layout.edges[-1])
    by_colour = {channel: np.zeros((count, count)) for channel in bases}
    # Where one pattern is enough, one colour is too: the others' matrices follow from its own.
    first = next(iter(bases))
    enough = len(bases) > 1 and shots[0].counts.size >= SAMPLE
    chosen = _sample([shot for shot in shots if shot.channel == first] if enough else shots)
    columns = Columns({c: bases[c] for c in dict.fromkeys(s.channel for s, *_ in chosen)}, estimate, layout)
    for number, (shot, pixels, share) in enumerate(chosen):
        matrix = by_colour[shot.channel]
        light = columns.predictor.light(shot)
        gain, root = gain_of(shot, light), np.sqrt(shot.weight).ravel()[pixels]
        along = root * light.ravel()[pixels]
        along /= max(math.sqrt(float(np.vdot(along, along))), 1e-30)
        rows = np.zeros((count, along.size), np.float32)
        for done, (place, column) in enumerate(columns.of(shot)):
            rows[place] = np.float32(gain) * root * column.ravel()[pixels]
            progress((number + done / count) / len(chosen))
        rows -= np.outer(rows @ along, along)
        for begin in range(0, along.size, BLOCK):
            block = rows[:, begin : begin + BLOCK].astype(np.float64)
            matrix += block @ block.T / share
    if enough:
        for channel in list(bases)[1:]:
            by_colour[channel] = _of_another_colour(by_colour[first], layout, bases, first, channel)
    return Information(layout, np.sum(list(by_colour.values()), 0) / len(shots))


def _of_another_colour(
    matrix: np.ndarray,
    layout: ParameterLayout,
    bases: Mapping[str, ColourLightPath],
    known: str,
    channel: str,
) -> np.ndarray:
    """The information of a colour's captures, from that of as many of another colour's.

    Both show like patterns at like exposures. A path difference turns the phase by its share of a wavelength, and a
    distance turns it, at each frequency, the more the longer the wavelength.
    """
    ratio = bases[channel].wavelength_nm / bases[known].wavelength_nm
    waves, beams, end = int(layout.edges[1]), int(layout.edges[2]), int(layout.edges[4])

    def places(name: str) -> np.ndarray:
        beam = waves + layout.channels.index(name) * layout.block
        return np.r_[0:waves, beam : beam + layout.block, beams:end]

    scale = np.ones(end)
    scale[:waves], scale[beams] = 1 / ratio, ratio
    own = waves + layout.channels.index(channel) * layout.block + layout.amplitude
    scale[own : own + layout.laser] = 1 / ratio
    scale, found = scale[places(channel)], np.zeros_like(matrix)
    found[np.ix_(places(channel), places(channel))] = (
        scale[:, None] * matrix[np.ix_(places(known), places(known))] * scale
    )
    return found


def _sample(shots: Sequence[Shot]) -> list[tuple[Shot, np.ndarray | slice, float]]:
    """Shots with the pixels to sample of each (all, or chosen at random), and which share of the colour's all they are.

    Every pixel of every pattern where there are few; else of as few patterns as will do, since each costs a propagation
    a number.
    """
    chosen: list[tuple[Shot, np.ndarray | slice, float]] = []
    rng = np.random.default_rng(0)
    for channel in dict.fromkeys(shot.channel for shot in shots):
        own = [shot for shot in shots if shot.channel == channel]
        size = own[0].counts.size
        some = own[: max(1, math.ceil(SAMPLE / size))]
        each = min(size, math.ceil(SAMPLE / len(some)))
        for shot in some:
            pixels = slice(None) if each == size else np.sort(rng.choice(size, each, replace=False))
            chosen.append((shot, pixels, len(some) * each / (len(own) * size)))
    return chosen
