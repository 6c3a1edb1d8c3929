"""Bicubic spline maps: exact where splines are, and the same surface on other nodes."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.lightpath.spline_maps import node_weights, nodes_over, on_other_nodes, spline_surface


@pytest.mark.parametrize(("pixels", "nodes"), [(40, 6), (41, 13), (7, 4)])
def test_weights_of_a_pixel_are_a_partition_of_unity(pixels: int, nodes: int) -> None:
    weights = node_weights(pixels, nodes)
    assert weights.shape == (pixels, nodes)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    assert weights.min() >= 0 and (weights > 0).sum(1).max() <= 4


def test_a_cubic_surface_is_exact_and_stays_so_on_other_nodes() -> None:
    y, x = np.linspace(-1, 1, 48)[:, None], np.linspace(-1, 1, 60)[None, :]
    surface = 1 + y - 2 * x * y + 0.5 * y**3 - x**2 * y + x**3
    shape = nodes_over(surface.shape, 12.0)
    rows, columns = (np.linalg.pinv(node_weights(n, m)) for n, m in zip(surface.shape, shape, strict=True))
    nodes = rows @ surface @ columns.T
    np.testing.assert_allclose(spline_surface(nodes, surface.shape), surface, atol=1e-9)
    for other in (shape[0] + 5, shape[1] + 3), (shape[0] - 1, shape[1]):
        again = on_other_nodes(nodes, other, surface.shape)
        np.testing.assert_allclose(spline_surface(again, surface.shape), surface, atol=1e-9)
