"""Smooth curves and surfaces as sums of Legendre polynomials, against the array API.

All are dimensionless and of order one, lowest order first; stacks of surfaces are [count, rows, columns]. Over a
panel or a picture, y and x run from -1 to 1 from edge to edge, at pixels' centres (`edge_to_edge`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from array_api_compat import array_namespace

Array = Any


def edge_to_edge(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of the pixels' centres, (y [H, W], x [H, W]), with the outer edges at -1 and 1."""
    y, x = ((2 * np.arange(n) + 1) / n - 1 for n in shape)
    return np.broadcast_to(y[:, None], shape), np.broadcast_to(x[None, :], shape)


def legendre_curve(t: Array, count: int) -> Array:
    """Legendre polynomials P_0 ... P_{count-1} of `t` in -1 .. 1: [count, *t.shape]."""
    xp = array_namespace(t)
    terms = [xp.ones_like(t), t]
    for n in range(1, count - 1):
        terms.append(((2 * n + 1) * t * terms[n] - n * terms[n - 1]) / (n + 1))
    return xp.stack(terms[:count])


def legendre_count(order: int, lowest: int = 1) -> int:
    """Number of Legendre products of total order `lowest` .. `order`."""
    return (order + 1) * (order + 2) // 2 - lowest * (lowest + 1) // 2


def legendre_maps(y: Array, x: Array, order: int, lowest: int = 1) -> Array:
    """Products P_i(y) P_j(x), lowest <= i + j <= order, y and x in -1 .. 1 (broadcast): [count, rows, columns]."""
    rows, columns = legendre_curve(y, order + 1), legendre_curve(x, order + 1)
    return array_namespace(y, x).stack(
        [rows[i, ...] * columns[j, ...] for i, j in legendre_products(order, lowest)]
    )


def legendre_map_by_map(shape: tuple[int, int], order: int, lowest: int = 1) -> Iterator[np.ndarray]:
    """`legendre_maps` over a panel or a picture, from edge to edge, one float32 map [H, W] at a time."""
    y, x = edge_to_edge(shape)
    rows, columns = (legendre_curve(t, order + 1).astype(np.float32) for t in (y[:, 0], x[0, :]))
    for i, j in legendre_products(order, lowest):
        yield rows[i, :, None] * columns[j]


def legendre_surface(terms: Array, y: Array, x: Array, lowest: int = 1) -> Array:
    """Sum of `terms` times `legendre_maps`, as two small matrix products instead of a stack.

    Parameters
    ----------
    terms : float array [count]
        The order follows from their number.
    y, x : float array [H, W]
        Coordinates over the rows and over the columns, -1 .. 1.
    lowest : int
        The lowest order among the terms.

    Returns
    -------
    float array [H, W]
    """
    xp = array_namespace(terms)
    order = legendre_order(terms.shape[0], lowest)
    places = legendre_products(order, lowest)
    pick = np.zeros((len(places), (order + 1) ** 2))  # where each term stands in the table of i and j
    for number, (i, j) in enumerate(places):
        pick[number, i * (order + 1) + j] = 1
    table = xp.reshape(
        terms @ xp.asarray(pick, dtype=terms.dtype, device=terms.device), (order + 1, order + 1)
    )
    rows, columns = legendre_curve(y[:, 0], order + 1), legendre_curve(x[0, :], order + 1)
    return xp.matrix_transpose(rows) @ table @ columns


def legendre_moments(values: np.ndarray, order: int, lowest: int = 1) -> np.ndarray:
    """The sum over a map of its product with each of `legendre_maps`: the adjoint of `legendre_surface`.

    Parameters
    ----------
    values : float array [H, W]
    order, lowest : int

    Returns
    -------
    float64 array [count]
    """
    y, x = edge_to_edge(values.shape)
    rows, columns = legendre_curve(y[:, 0], order + 1), legendre_curve(x[0, :], order + 1)
    table = (rows.astype(values.dtype) @ values).astype(np.float64) @ columns.T
    return np.array([table[i, j] for i, j in legendre_products(order, lowest)])


def legendre_order(count: int, lowest: int = 1) -> int:
    """The highest order of `count` terms from order `lowest` on."""
    return next(n for n in range(64) if legendre_count(n, lowest) == count)


def legendre_products(order: int, lowest: int = 1) -> list[tuple[int, int]]:
    """(i, j) of the products P_i(y) P_j(x), in the order in which surfaces hold them."""
    return [(n - m, m) for n in range(lowest, order + 1) for m in range(n + 1)]
