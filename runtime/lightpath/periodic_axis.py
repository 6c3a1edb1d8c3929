"""Windows on a periodic axis: samples taken out, and put back as the adjoint. Against the array API.

A run is (start, stop) within one period. A window that goes past the period's end is several runs, and one
that is longer than the period has samples in more than one of them.
"""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

Array = Any


def ring(first: int, count: int, period: int) -> list[tuple[int, int]]:
    """`count` samples of a periodic axis from `first` on, as (start, stop) runs within one period."""
    runs = []
    while count:
        start = first % period
        length = min(count, period - start)
        runs.append((start, start + length))
        first, count = first + length, count - length
    return runs


def take(x: Array, runs: list[tuple[int, int]], axis: int) -> Array:
    """The samples of `runs` of an axis, one after the other."""
    xp = array_namespace(x)
    parts = [_along(x, start, stop, axis) for start, stop in runs]
    return parts[0] if len(parts) == 1 else xp.concat(parts, axis=axis)


def put(x: Array, runs: list[tuple[int, int]], axis: int, period: int) -> Array:
    """Adjoint of `take`: samples back at their places on an axis of `period` samples, zero elsewhere."""
    xp = array_namespace(x)
    shape = list(x.shape)
    shape[axis] = period
    whole = xp.zeros(tuple(shape), dtype=x.dtype, device=x.device)
    done = 0
    for start, stop in runs:
        part = _along(whole, start, stop, axis)
        part += _along(x, done, done + stop - start, axis)
        done += stop - start
    return whole


def _along(x: Array, start: int, stop: int, axis: int) -> Array:
    """A view of samples start .. stop of an axis."""
    inside: list[Any] = [slice(None)] * x.ndim
    inside[axis] = slice(start, stop)
    return x[tuple(inside)]
