"""Crosstalk between pixels: weighted sums of neighbours along an axis, and their adjoint, by the array API."""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

from runtime.lightpath.periodic_axis import take

Array = Any


def mix_neighbours(phase: Array, taps: Array, axis: int) -> Array:
    """Weighted sums of each pixel and its neighbours along an axis; border pixels repeat beyond the border.

    Parameters
    ----------
    phase : float array [..., H, W]
    taps : float array [n, taps]
        Weights of each sum.

    Returns
    -------
    float array [n, ..., H, W]
        The sum of each row of taps.
    """
    xp = array_namespace(phase)
    reach, count = (taps.shape[1] - 1) // 2, phase.shape[axis]
    wide = take(phase, [(0, 1)] * reach + [(0, count)] + [(count - 1, count)] * reach, axis)
    runs = xp.stack([take(wide, [(k, k + count)], axis) for k in range(taps.shape[1])])
    return xp.tensordot(taps, runs, axes=1)


def mix_neighbours_adjoint(gradient: Array, taps: Array, axis: int) -> Array:
    """Adjoint of one of the sums of `mix_neighbours`, with its own taps [taps]."""
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
