"""Transfer functions of a blur with a core, from peaked to a ring, and a halo."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from trainer.effects.bessel import bessel_j0, bessel_j1_over_x
from trainer.effects.definition import Parameter

# What a core and a halo are described by, besides their widths.
CORE_AND_HALO = (
    Parameter(
        "kurtosis",
        "1",
        scale=0.5,
        low=-1.5,
        high=1.5,
        about="shape: 0 Gaussian, -1 uniform disc, -1.5 ring",
        typical=(-1.5, 1.5),
    ),
    Parameter(
        "halo",
        "1",
        scale=0.05,
        low=0,
        high=0.9,
        about="share of the light in a wider, round part",
        typical=(0, 0.5),
    ),
)

MOST_DECAY = 40.0  # so that the product of two has a normal number


def kernel_transfer(
    iy: Tensor, ix: Tensor, widths: tuple[Tensor, Tensor, Tensor], kurtosis: Tensor, halo: Tensor
) -> Tensor:
    """Transfer function of a blur kernel with a core and a halo.

    Parameters
    ----------
    iy, ix : Tensor
        Image frequencies, in cycles per unit of `widths`.
    widths : (Tensor, Tensor, Tensor)
        rms along rows and columns, and of the halo.
    kurtosis : Tensor
    halo : Tensor
        Its share of the light.

    Returns
    -------
    Tensor [n, m]
    """
    ky, kx = 2 * math.pi * iy, 2 * math.pi * ix
    return (1 - halo) * kernel_core(ky, kx, widths[:2], kurtosis) + halo * kernel_halo(ky, kx, widths[2])


def kernel_core(ky: Tensor, kx: Tensor, widths: tuple[Tensor, Tensor], kurtosis: Tensor) -> Tensor:
    """Transfer function of a core, the same rms width whatever its kurtosis, over radians per unit of `widths`.

    With w = k width: at a kurtosis of 0 a Gaussian, exp(-w^2/2); at -1 a uniform disc, J1(2w)/w; at -1.5 a ring,
    J0(sqrt(2) w); between two of these a sum of both. Above 0 it is the first two even cumulants,
    exp(-w^2/2 + kurtosis w^4/24), the second limited to half of the first, where the expansion ends.
    """
    w2 = (widths[0] * ky) ** 2 + (widths[1] * kx) ** 2
    if float(kurtosis.detach()) < 0:
        return _flat_topped(w2, -kurtosis)
    return decayed(w2 * (torch.clamp(kurtosis * w2 / 24, max=0.25) - 0.5))


def kernel_halo(ky: Tensor, kx: Tensor, width: Tensor) -> Tensor:
    """Transfer function of a round Gaussian halo, over radians per unit of its rms width."""
    return decayed(-0.5 * width**2 * (ky**2 + kx**2))


def decayed(exponent: Tensor) -> Tensor:
    """exp of what is 0 or less, down to a least one: where no normal number is left, exp is thirty times as slow."""
    return torch.exp(torch.clamp(exponent, min=-MOST_DECAY))


def _flat_topped(w2: Tensor, flatness: Tensor) -> Tensor:
    """The core between a Gaussian (flatness 0), a disc (1) and a ring (1.5), at squared frequencies w^2."""
    w = torch.sqrt(torch.clamp(w2, min=1e-8))  # a quotient has no value at 0
    disc = 2 * bessel_j1_over_x(2 * w)
    if float(flatness.detach()) <= 1:
        return torch.lerp(decayed(-0.5 * w2), disc, flatness)
    return torch.lerp(disc, bessel_j0(math.sqrt(2) * w), 2 * (flatness - 1))
