"""Smooth maps and curves given by the nodes of cubic B-splines: what goes on where polynomials end."""

from __future__ import annotations

import numpy as np


def node_weights(pixels: int, nodes: int) -> np.ndarray:
    """Weights of evenly spaced nodes of a cubic B-spline at pixels along an axis: float64 [pixels, nodes]."""
    return weights_at(np.arange(pixels), -0.5, pixels - 0.5, nodes)


def weights_at(places: np.ndarray, first: float, last: float, nodes: int) -> np.ndarray:
    """Weights of `nodes` evenly spaced nodes of a cubic B-spline over `first` .. `last`: float64 [places, nodes].

    Places beyond the ends have the end's weights.
    """
    from scipy.interpolate import BSpline  # takes a second to load, and few light paths have maps

    knots = np.concatenate([np.full(3, first), np.linspace(first, last, nodes - 2), np.full(3, last)])
    return np.asarray(BSpline.design_matrix(np.clip(places, first, last), knots, 3).toarray())


def spline_surface(nodes: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The surface [H, W] of a bicubic B-spline's nodes [m, n]; 0 without nodes."""
    if not nodes.size:
        return np.zeros(shape)
    rows, columns = (node_weights(n, m) for n, m in zip(shape, nodes.shape, strict=True))
    return np.asarray(rows @ nodes @ columns.T)


def nodes_over(shape: tuple[int, int], spacing: float) -> tuple[int, int]:
    """Nodes (rows, columns) of a map over a number of pixels, about `spacing` pixels apart."""
    return tuple(int(np.ceil(n / spacing)) + 3 for n in shape)  # type: ignore[return-value]


def on_other_nodes(nodes: np.ndarray, other: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """The nodes of another grid [m, n] that give nearly the same surface over a number of pixels."""
    rows, columns = (
        np.linalg.lstsq(node_weights(n, to), node_weights(n, from_), rcond=None)[0]
        for n, to, from_ in zip(shape, other, nodes.shape, strict=True)
    )
    return np.asarray(rows @ nodes @ columns.T)
