"""Crosstalk between pixels: weighted sums of neighbours along an axis, and their adjoint, by the array API."""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

from runtime.lightpath.periodic_axis import take

Array = Any


def mix_neighbours(phase: Array, taps: Array, axis: int) -> Array:
    """Weighted sum of each pixel and its neighbours along an axis; border pixels repeat beyond the border."""
    reach, count = (taps.shape[0] - 1) // 2, phase.shape[axis]
    # Runs of a wider array take a quarter of the time of indices that stop at the border.
    wide = take(phase, [(0, 1)] * reach + [(0, count)] + [(count - 1, count)] * reach, axis)
    return sum(taps[k] * take(wide, [(k, k + count)], axis) for k in range(taps.shape[0]))


def mix_neighbours_adjoint(gradient: Array, taps: Array, axis: int) -> Array:
    """Adjoint of `mix_neighbours`."""
    xp = array_namespace(gradient)
    reach = (taps.shape[0] - 1) // 2
    moved = xp.moveaxis(gradient, axis, -1)
    count = moved.shape[-1]
    total = xp.zeros_like(moved)
    for k in range(taps.shape[0]):
        shift = k - reach
        part = taps[k] * moved
        first, last = max(0, shift), min(count, count + shift)
        total[..., first:last] += part[..., first - shift : last - shift]
        if shift < 0:
            total[..., 0] += xp.sum(part[..., :-shift], axis=-1)
        elif shift > 0:
            total[..., -1] += xp.sum(part[..., count - shift :], axis=-1)
    return xp.moveaxis(total, -1, axis)
