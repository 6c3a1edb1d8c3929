"""Phase from measured first-order power: reads the power meter's records of real panels that tests compare with."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from firmware_iface.errors import InputError

PROMINENCE = 0.25  # of the range of power: what turns less than this is noise


def phase_of_power(power: np.ndarray) -> np.ndarray:
    """Phase of each gray level from the first-order power of gratings of gray 0 and that gray.

    Power goes as (1 - cos phase) / 2 between its extremes, which may differ from turn to turn, as on a real panel.
    Phase starts at 0 and only grows; beyond the last extreme the last range of power holds.

    Parameters
    ----------
    power : float array [levels]

    Returns
    -------
    float array [levels], rad

    Raises
    ------
    InputError
        Where power never turns, so that there is no half wave to measure by.
    """
    power = np.asarray(power, float)
    smooth = gaussian_filter1d(power, 1.0)
    least = PROMINENCE * float(np.ptp(smooth))
    turns = np.sort(np.concatenate([find_peaks(s * smooth, prominence=least)[0] for s in (1, -1)]))
    if len(turns) == 0:
        raise InputError(
            "the first order's power has no maximum over the gray levels, so the panel's phase stays below half a "
            "wave: give it more voltage range, or sweep at a shorter wavelength"
        )
    edges = [0, *turns.tolist(), len(power) - 1]
    phase = np.zeros(len(power))
    low, high = smooth[0], smooth[turns[0]]
    for half, (first, last) in enumerate(pairwise(edges)):
        if half < len(turns):
            low, high = smooth[first], smooth[last]
        else:  # an unfinished half wave: it would reach what the one before came from
            low, high = smooth[first], smooth[edges[half - 1]]
        inside = slice(first, last + 1)
        share = np.clip((power[inside] - low) / (high - low), 0, 1)
        phase[inside] = math.pi * half + np.arccos(1 - 2 * share)
    return np.maximum.accumulate(phase)
