"""Bessel functions of the first kind that can be differentiated: torch takes its own for constants.

In single precision they are read off tables, to 3e-7: torch's own take five times as long.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from trainer.kept_results import kept_by_device

REACH, INVERSE_STEP = 128, 512  # of the tables; a step that is a power of two rounds no argument


class _J0(torch.autograd.Function):
    """J0, whose derivative is -J1."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return _read_off(torch.special.bessel_j0, x)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return -slope * torch.special.bessel_j1(x)


class _J1OverX(torch.autograd.Function):
    """J1(x) / x, whose derivative is J0(x) / x - 2 J1(x) / x^2."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return _read_off(_j1_over_x, x)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return slope * (torch.special.bessel_j0(x) - 2 * torch.special.bessel_j1(x) / x) / x


def _j1_over_x(x: Tensor) -> Tensor:
    return torch.where(x == 0, 0.5, torch.special.bessel_j1(x) / x)


@kept_by_device(2)
def _table(function: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Values of a function at the steps up to REACH, and how much each step adds; single precision."""
    values = function(torch.arange(REACH * INVERSE_STEP + 1, dtype=torch.float64) / INVERSE_STEP)
    return values[:-1].float(), values.diff().float()


def _read_off(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """An even function of a tensor, linear between the steps of its table; beyond it, the function itself."""
    if x.dtype != torch.float32 or float(x.abs().max()) >= REACH:
        return function(x)
    values, added = _table(function)
    place = x.abs() * INVERSE_STEP
    step = place.to(torch.int32)
    part, step = place - step, step.reshape(-1)
    found: Tensor = values.index_select(0, step).reshape(x.shape)
    return found + part * added.index_select(0, step).reshape(x.shape)


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
