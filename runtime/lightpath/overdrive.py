"""Gray levels for a slow panel: overdriven, so that a pixel has the wanted phase when its pattern's time is over.

A slow panel (the effect `slow_response`) keeps a share s of the phase before, until a pattern's time is over:

    phi_reached = (1 - s) phi_sent + s phi_before

So phi_sent = phi_before + (phi_wanted - phi_before) / (1 - s) reaches phi_wanted. Where the panel's range does not hold
it, the level is sent that comes nearest on the circle of one wave: often a whole wave up or down, which is less far to
go. The other way, without whole waves, ends at the wanted level itself when a pattern stays.

References
----------
Thalhammer et al. 2013, Speeding up liquid crystal SLMs using overdrive with phase change reduction, Opt. Express 21,
1779.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

GRAYS = 256
TABLES = (3, GRAYS, GRAYS)
WAVE = 2 * math.pi
NEAREST, STRAIGHT, REACHED = range(3)  # the tables
EQUAL_RAD = 1e-9
SETTLED = 1 / 512  # of the phase before: half a level of a whole wave

Phases = NDArray[np.float64]
Levels = NDArray[np.intp]


def overdrive_tables(
    response: NDArray[np.floating], share: float, gray_levels: Sequence[int] = ()
) -> NDArray[np.uint8]:
    """What to send to a slow panel, and what is reached with it, for each pair of gray levels.

    What a panel shows is described by the level that would show it for good.

    Parameters
    ----------
    response : float array [levels], rad
        Phase of each gray level.
    share : float
        Of the phase before that is left when a pattern's time is over, 0 to less than 1.
    gray_levels : sequence of int
        Those that the panel has, where it has few; empty: all.

    Returns
    -------
    uint8 array [3, 256, 256]
        At NEAREST and STRAIGHT, the level to send at [level before, wanted level]: nearest on the circle, and without
        whole waves. At REACHED, the level that is reached, at [level before, level sent].
    """
    phase = np.asarray(response, np.float64)[np.minimum(np.arange(GRAYS), len(response) - 1)]
    has = np.asarray(gray_levels if len(gray_levels) else range(min(len(response), GRAYS)), np.intp)
    tables = np.empty(TABLES, np.uint8)
    tables[REACHED] = _reached(phase, share, has)
    before, wanted = phase[:, None], phase[None, :]
    exact = before + (wanted - before) / (1 - share)
    sent = _nearest(exact, phase, has)
    as_near = np.abs(wanted - exact) <= np.abs(phase[sent] - exact) + EQUAL_RAD
    sent = np.where(as_near & np.isin(np.arange(GRAYS), has), np.arange(GRAYS), sent)
    tables[STRAIGHT] = sent
    error = np.abs((1 - share) * phase[sent] + share * before - wanted)
    beyond = (exact < phase[has].min()) | (exact > phase[has].max())
    waves = math.ceil(np.ptp(phase[has]) / WAVE)
    for turns in (n for n in range(-waves, waves + 1) if n):
        other = _nearest(exact + turns * WAVE / (1 - share), phase, has)
        off = np.abs((1 - share) * phase[other] + share * before - wanted - turns * WAVE)
        nearer = beyond & (off < error)
        sent, error = np.where(nearer, other, sent), np.where(nearer, off, error)
    tables[NEAREST] = sent
    return tables


def settling_periods(share: float) -> int:
    """For how many periods a pattern has to stay, after its first, until a slow panel shows it alone."""
    return 0 if share <= SETTLED else math.ceil(math.log(SETTLED) / math.log(share)) - 1


def _reached(phase: Phases, share: float, has: Levels) -> Levels:
    """The level that is reached, at [level before, level sent].

    At least one level on, so that a pattern that stays is reached, however slow the panel.
    """
    phases, first = np.unique(phase[has], return_index=True)
    place = _places(phase, phases)
    before, sent = place[:, None], place[None, :]
    reached = _places((1 - share) * phase[None, :] + share * phase[:, None], phases)
    reached = np.where(reached == before, before + np.sign(sent - before), reached)
    return np.asarray(has[first[reached]])


def _nearest(wanted: Phases, phase: Phases, has: Levels) -> Levels:
    """The levels that a panel has whose phase is nearest."""
    phases, first = np.unique(phase[has], return_index=True)
    return np.asarray(has[first[_places(wanted, phases)]])


def _places(wanted: Phases, phases: Phases) -> Levels:
    """Where in rising `phases` the nearest to each of `wanted` is."""
    return np.asarray(np.searchsorted((phases[1:] + phases[:-1]) / 2, wanted))
