"""Smooth shapes that maps and curves are made of: Legendre products on a rectangle, Zernike on a disc.

All are dimensionless and of order one, lowest order first; each is a stack [count, rows, columns] or
[count, samples].
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def legendre_curve(t: Tensor, count: int) -> Tensor:
    """Legendre polynomials P_0 ... P_{count-1} of `t` in -1 .. 1: [count, *t.shape]."""
    terms = [torch.ones_like(t), t]
    for n in range(1, count - 1):
        terms.append(((2 * n + 1) * t * terms[n] - n * terms[n - 1]) / (n + 1))
    return torch.stack(terms[:count])


def legendre_count(order: int, lowest: int = 1) -> int:
    """Number of Legendre products of total order `lowest` .. `order`."""
    return (order + 1) * (order + 2) // 2 - lowest * (lowest + 1) // 2


def legendre_maps(y: Tensor, x: Tensor, order: int, lowest: int = 1) -> Tensor:
    """Products P_i(y) P_j(x), lowest <= i + j <= order, y and x in -1 .. 1 (broadcast): [count, rows, columns]."""
    rows, columns = legendre_curve(y, order + 1), legendre_curve(x, order + 1)
    return torch.stack([rows[n - m] * columns[m] for n in range(lowest, order + 1) for m in range(n + 1)])


def legendre_surface(terms: Tensor, y: Tensor, x: Tensor, lowest: int = 1) -> Tensor:
    """Sum of `terms` times `legendre_maps`, over the grid that y [H, W] (rows) and x [H, W] (columns) span: [H, W].

    Two small matrix products instead of a stack of maps. The order follows from the number of terms.
    """
    order = next(n for n in range(64) if legendre_count(n, lowest) == terms.shape[0])
    places = [(n - m, m) for n in range(lowest, order + 1) for m in range(n + 1)]
    table = torch.zeros((order + 1, order + 1), dtype=terms.dtype)
    if places:
        rows, columns = (torch.tensor(k) for k in zip(*places, strict=True))
        table = table.index_put((rows, columns), terms)
    return legendre_curve(y[:, 0], order + 1).T @ table @ legendre_curve(x[0, :], order + 1)


def zernike_indices(order: int, without_defocus: bool = False) -> list[tuple[int, int]]:
    """(n, m) of the Zernike polynomials from tilt (n = 1) to n = `order`, or without tilt and defocus."""
    every = [(n, m) for n in range(1, order + 1) for m in range(-n, n + 1, 2)]
    return [i for i in every if i[0] > 1 and i != (2, 0)] if without_defocus else every


def zernike_count(order: int, without_defocus: bool = False) -> int:
    """Number of polynomials that `zernike_indices` lists."""
    return len(zernike_indices(order, without_defocus))


def zernike_maps(y: Tensor, x: Tensor, order: int, without_defocus: bool = False) -> Tensor:
    """Zernike polynomials over coordinates in units of the pupil's radius, rms 1 on the disc: [count, ...].

    Noll's normalisation (J. Opt. Soc. Am. 66, 207, 1976), ordered by n then m; sine terms have negative m.
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
