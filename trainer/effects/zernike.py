"""Zernike polynomials on a disc: dimensionless and of order one, lowest order first, a stack [count, ...]."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def zernike_indices(order: int, without_defocus: bool = False) -> list[tuple[int, int]]:
    """(n, m) of the Zernike polynomials from tilt (n = 1) to n = `order`, or without tilt and defocus."""
    every = [(n, m) for n in range(1, order + 1) for m in range(-n, n + 1, 2)]
    return [i for i in every if i[0] > 1 and i != (2, 0)] if without_defocus else every


def zernike_count(order: int, without_defocus: bool = False) -> int:
    """Number of polynomials that `zernike_indices` lists."""
    return len(zernike_indices(order, without_defocus))


def zernike_maps(y: Tensor, x: Tensor, order: int, without_defocus: bool = False) -> Tensor:
    """Zernike polynomials over coordinates, rms 1 on the disc.

    Noll's normalisation, ordered by n, then m; sine terms have negative m.

    Parameters
    ----------
    y, x : Tensor, pupil radii
    order : int
        Highest n.
    without_defocus : bool
        Leave out tilt and defocus.

    Returns
    -------
    Tensor [count, ...]

    References
    ----------
    Noll 1976.
    """
    y, x = torch.broadcast_tensors(y, x)
    radius2 = y**2 + x**2
    # r^|m| cos(m a) and sin(m a) as polynomials of x + j y: no angle, so no singular point at the centre.
    power = [(torch.ones_like(x), torch.zeros_like(x))]
    for _ in range(order):
        real, imaginary = power[-1]
        power.append((real * x - imaginary * y, real * y + imaginary * x))
    maps = []
    for n, m in zernike_indices(order, without_defocus):
        k = abs(m)
        radial = torch.zeros_like(x)
        for s in range((n - k) // 2 + 1):
            weight = (
                (-1) ** s
                * math.factorial(n - s)
                / (math.factorial(s) * math.factorial((n + k) // 2 - s) * math.factorial((n - k) // 2 - s))
            )
            radial = radial + weight * radius2 ** ((n - k) // 2 - s)
        norm = math.sqrt((n + 1) * (1 if m == 0 else 2))
        maps.append(norm * radial * power[k][1 if m < 0 else 0])
    return torch.stack(maps)
