"""The gray levels that a panel really has: others are shown as the nearest of these."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from firmware_iface.errors import InputError


def checked_gray_levels(given: Any, where: str) -> tuple[int, ...]:
    """Gray levels that a panel has; none given: all of them.

    Parameters
    ----------
    given : list of int, or None
    where : str
        How to name them in an error.

    Raises
    ------
    InputError
        Unless they are two or more whole numbers from 0 to 255, each larger than the one before.
    """
    if given is None:
        return ()
    good = isinstance(given, list | tuple) and len(given) >= 2 and all(type(gray) is int for gray in given)
    if (
        not good
        or given[0] < 0
        or given[-1] > 255
        or any(gray >= following for gray, following in pairwise(given))
    ):
        raise InputError(
            f"{where} is not a list of gray levels: write two or more whole numbers from 0 to 255, each larger than "
            "the one before, or leave it out where the panel has all"
        )
    return tuple(given)


def shown_as(gray_levels: Sequence[int], levels: float) -> np.ndarray:
    """The gray level that a panel shows for each of 0 to 255: the nearest that it has, on the circle of one wave.

    Parameters
    ----------
    gray_levels : sequence of int
        Those that it has; empty: all.
    levels : float
        Gray levels of one wave.

    Returns
    -------
    int array [256]
    """
    if not gray_levels:
        return np.arange(256)
    has = np.asarray(gray_levels)
    apart = np.abs(np.arange(256)[:, None] - has) % levels
    return np.asarray(has[np.minimum(apart, levels - apart).argmin(1)])
