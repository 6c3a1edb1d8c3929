"""What a panel does to light besides delaying it: a factor on the field that depends on the pixel's own phase.

A liquid-crystal panel may absorb as it delays, pass a second polarisation with a phase of its own, or let its phase
swing during an exposure. All of these are a complex factor over phase, in one or several states whose irradiances
add. Written against the array API.
"""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

Array = Any
Modulation = tuple[Array, Array, Array]


def factor_at(modulation: Modulation, phase: Array) -> Array:
    """Factor on the field of the first state at phases (rad); linear between the table's samples."""
    ends, factors, _ = modulation
    xp = array_namespace(phase)
    below, share, _ = _place(ends, factors, phase)
    first, then = _taken(xp, factors, below), _taken(xp, factors, below + 1)
    return first + share * (then - first)


def slope_at(modulation: Modulation, phase: Array) -> Array:
    """Derivative of `factor_at` over phase, per rad."""
    ends, factors, _ = modulation
    xp = array_namespace(phase)
    below, _, inside = _place(ends, factors, phase)
    step = (ends[1] - ends[0]) / (factors.shape[1] - 1)
    return inside * (_taken(xp, factors, below + 1) - _taken(xp, factors, below)) / step


def _place(ends: Array, factors: Array, phase: Array) -> tuple[Array, Array, Array]:
    """Sample below a phase, the share of the way to the next one, and 1 within the table's range, else 0."""
    xp = array_namespace(phase)
    last = factors.shape[1] - 1
    place = (phase - ends[0]) * (last / (ends[1] - ends[0]))
    held = xp.clip(place, 0, last)
    below = xp.astype(xp.clip(xp.floor(held), 0, last - 1), xp.int64)
    return below, held - xp.astype(below, held.dtype), xp.astype(held == place, held.dtype)


def _taken(xp: Any, factors: Array, index: Array) -> Array:
    return xp.reshape(xp.take(factors[0, ...], xp.reshape(index, (-1,)), axis=0), tuple(index.shape))
