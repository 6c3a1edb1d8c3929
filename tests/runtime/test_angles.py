"""Angles by polynomials are those of the C library, to a thousandth of a gray level."""

from __future__ import annotations

import math

import numpy as np
import pytest

from runtime.solver.angles import angle_into, arccos_into

GRAY_LEVEL = 2 * math.pi / 256


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_angles_all_around_at_all_sizes(dtype: type) -> None:
    turn = np.linspace(-math.pi, math.pi, 8 * 997 + 1)
    sizes = np.array([1e-12, 1e-3, 1.0, 1e6])[:, None]
    y, x = (np.asarray(sizes * f(turn), dtype) for f in (np.sin, np.cos))
    out = np.empty_like(y)
    angle_into(np, y, x, out, [np.empty_like(y) for _ in range(3)])
    assert out.dtype == dtype
    assert np.abs(np.exp(1j * out) - np.exp(1j * turn)).max() < 1e-3 * GRAY_LEVEL


def test_the_angle_of_the_axes_and_of_nothing() -> None:
    y, x = np.array([[0.0, 0, 1, -1, 0]]), np.array([[1.0, -1, 0, 0, 0]])
    out = np.empty_like(y)
    angle_into(np, y, x, out, [np.empty_like(y) for _ in range(3)])
    np.testing.assert_allclose(out, np.arctan2(y, x), atol=2e-5)


def test_arccos_from_0_to_1() -> None:
    x = np.linspace(0, 1, 10_001, dtype=np.float32)[None]
    out = np.empty_like(x)
    arccos_into(np, x, out, np.empty_like(x))
    np.testing.assert_allclose(out, np.arccos(x), atol=1e-6)
