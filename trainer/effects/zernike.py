"""Zernike polynomials on a disc: dimensionless and of order one, lowest order first."""

from __future__ import annotations

import math
from itertools import product

import torch
from torch import Tensor

from trainer.kept_results import kept_by_device


def zernike_indices(order: int, without_defocus: bool = False) -> list[tuple[int, int]]:
    """(n, m) of the Zernike polynomials from tilt (n = 1) to n = `order`, or without tilt and defocus."""
    every = [(n, m) for n in range(1, order + 1) for m in range(-n, n + 1, 2)]
    return [i for i in every if i[0] > 1 and i != (2, 0)] if without_defocus else every


def zernike_count(order: int, without_defocus: bool = False) -> int:
    """Number of polynomials that `zernike_indices` lists."""
    return len(zernike_indices(order, without_defocus))


def zernike_surface(terms: Tensor, y: Tensor, x: Tensor, order: int, without_defocus: bool = False) -> Tensor:
    """Sum of `terms` times Zernike polynomials of rms 1 on the disc, as two small matrix products.

    Noll's normalisation, ordered by n, then m; sine terms have negative m.

    Parameters
    ----------
    terms : Tensor [count]
    y, x : Tensor [n, 1] and [1, m], pupil radii
    order : int
        Highest n.
    without_defocus : bool
        Leave out tilt and defocus.

    Returns
    -------
    Tensor [n, m]

    References
    ----------
    Noll 1976.
    """
    table = torch.tensordot(terms, _monomials(order, without_defocus).to(terms), dims=1)
    exponents = torch.arange(order + 1, device=y.device)
    return y**exponents @ table @ (x.T**exponents).T


@kept_by_device(8)
def _monomials(order: int, without_defocus: bool) -> Tensor:
    """Coefficient [count, i, j] of y^i x^j in each polynomial."""
    indices = zernike_indices(order, without_defocus)
    table = torch.zeros((len(indices), order + 1, order + 1), dtype=torch.float64)
    for one, (n, m) in enumerate(indices):
        k = abs(m)
        norm = math.sqrt((n + 1) * (1 if m == 0 else 2))
        for s in range((n - k) // 2 + 1):
            p = (n - k) // 2 - s
            weight = (-1) ** s * math.factorial(n - s) * norm
            weight /= math.factorial(s) * math.factorial((n + k) // 2 - s) * math.factorial(p)
            # r^2p, and r^k cos(k a) or sin(k a) as the real or imaginary part of (x + j y)^k.
            for q, t in product(range(p + 1), range(1 if m < 0 else 0, k + 1, 2)):
                sign = (-1) ** (t // 2)
                table[one, 2 * q + t, 2 * (p - q) + k - t] += (
                    sign * weight * math.comb(p, q) * math.comb(k, t)
                )
    return table
