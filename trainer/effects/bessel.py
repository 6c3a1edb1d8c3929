"""Bessel functions of the first kind that can be differentiated: torch takes its own for constants."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _J0(torch.autograd.Function):
    """J0, whose derivative is -J1."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.special.bessel_j0(x)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return -slope * torch.special.bessel_j1(x)


class _J1OverX(torch.autograd.Function):
    """J1(x) / x, whose derivative is J0(x) / x - 2 J1(x) / x^2."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.special.bessel_j1(x) / x

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return slope * (torch.special.bessel_j0(x) - 2 * torch.special.bessel_j1(x) / x) / x


def bessel_j0(x: Tensor) -> Tensor:
    """J0 of a real tensor: the transfer function of a thin ring.

    References
    ----------
    Abramowitz and Stegun 1964, 9.1.28.
    """
    return _J0.apply(x)


def bessel_j1_over_x(x: Tensor) -> Tensor:
    """J1(x) / x of a real tensor without zeros: half the transfer function of a uniform disc.

    References
    ----------
    Abramowitz and Stegun 1964, 9.1.30.
    """
    return _J1OverX.apply(x)
