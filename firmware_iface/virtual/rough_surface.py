"""A smooth random surface: natural cubic splines through random nodes, along one axis and then the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rough_surface(nodes: tuple[int, int], seed: int, height: int, width: int) -> Array:
    """A surface of mean 0 and rms 1 through Gaussian random nodes.

    Parameters
    ----------
    nodes : (int, int)
        (rows, columns) of nodes, at least 2, from edge to edge.
    seed : int
    height, width : int
        Samples, cell centres.

    Returns
    -------
    float64 array [height, width]
    """
    heights = np.random.default_rng([seed, 61]).standard_normal(nodes)
    surface = spline_weights(height, nodes[0]) @ heights @ spline_weights(width, nodes[1]).T
    surface -= surface.mean()
    return np.asarray(surface / np.sqrt(np.mean(surface**2)))


def spline_weights(samples: int, nodes: int) -> Array:
    """From values at `nodes` equidistant nodes to a natural cubic spline at cell centres, [samples, nodes]."""
    at = (np.arange(samples) + 0.5) / samples * (nodes - 1)
    k = np.minimum(at.astype(np.int64), nodes - 2)
    t = (at - k)[:, None]
    value = np.eye(nodes)
    # second derivatives m: m[i - 1] + 4 m[i] + m[i + 1] = 6 (y[i - 1] - 2 y[i] + y[i + 1]), 0 at both ends
    bend = np.zeros((nodes, nodes))
    if nodes > 2:
        inner = 4 * np.eye(nodes - 2) + np.eye(nodes - 2, k=1) + np.eye(nodes - 2, k=-1)
        bend[1:-1] = np.linalg.solve(inner, 6 * (value[:-2] - 2 * value[1:-1] + value[2:]))
    left = (1 - t) * value[k] + ((1 - t) ** 3 - (1 - t)) / 6 * bend[k]
    return np.asarray(left + t * value[k + 1] + (t**3 - t) / 6 * bend[k + 1])
