"""Bessel functions against SciPy's, and their derivatives against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special
import torch

from trainer.effects.bessel import bessel_j0, bessel_j1_over_x

X = torch.linspace(0.05, 30, 400, dtype=torch.float64)


def test_values_are_those_of_scipy() -> None:
    np.testing.assert_allclose(bessel_j0(X), scipy.special.j0(X.numpy()), atol=1e-6)
    np.testing.assert_allclose(bessel_j1_over_x(X), scipy.special.j1(X.numpy()) / X.numpy(), atol=1e-6)


@pytest.mark.parametrize("largest", [120.0, 200.0])
def test_single_precision_is_as_good_within_the_tables_and_beyond(largest: float) -> None:
    x = torch.linspace(0.01, largest, 99999, dtype=torch.float64).float().reshape(3, -1)
    exact = x.double().numpy()
    np.testing.assert_allclose(bessel_j0(x), scipy.special.j0(exact), atol=1e-6)
    np.testing.assert_allclose(bessel_j1_over_x(x), scipy.special.j1(exact) / exact, atol=1e-6)


def test_derivatives_are_those_of_finite_differences() -> None:
    for function in (bessel_j0, bessel_j1_over_x):
        assert torch.autograd.gradcheck(function, X[::20].clone().requires_grad_())
