"""Keeps light that the panel does not modulate out of the picture: an iris off the axis and a ramp on the pattern."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath

GUARD = 0.05  # of the panel's band, from the zero order to the opening


def beside_zero_order(path: LightPath) -> LightPath:
    """The path with its iris closed below the axis and up to a guard above it.

    Undiffracted light (leak, gaps between pixels) comes to a focus on the axis of the iris's plane and stops
    there; so do the ghosts that mirror the picture about it. The solver's start finds the pattern's ramp, which
    brings the light to the opening's middle, from the path. The bench's iris has to be moved in the same way: its
    opening, in cycles/mm, is from GUARD / (2 pitch) up to where the path's own ends. Half of the light's bandwidth
    down the picture is lost.

    Raises
    ------
    InputError
        For an iris that leaves no such opening.
    """
    cycles = np.asarray(path.grid.frequency_index(0)) / path.grid.padded[0]
    kept = cycles >= GUARD / 2
    passed = np.abs(path.transfers).max((0, 2)) > 0
    if np.count_nonzero(kept & passed) < 4:
        raise InputError("the iris passes too little above its axis: export the bundle with a wider one")
    return replace(path, transfers=path.transfers * kept[:, None].astype(path.response.dtype))
