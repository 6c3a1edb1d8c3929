"""Layers that state their own short gradients, so that the ONNX export traces them into few operations."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

EPS = 1e-5  # added to an instance's variance


class _LeakyReLU(torch.autograd.Function):
    """Saves the result alone: its sign gives the slope for the backward pass."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, slope: float) -> Tensor:
        y = functional.leaky_relu(x, slope)
        ctx.save_for_backward(y)
        ctx.slope = slope
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (y,) = ctx.saved_tensors
        return torch.where(y > 0, gradients[0], gradients[0] * ctx.slope), None


class _InstanceNorm(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        deviation = x - x.mean((2, 3), keepdim=True)
        scale = torch.rsqrt((deviation * deviation).mean((2, 3), keepdim=True) + EPS)
        y = deviation * scale
        ctx.save_for_backward(y, scale)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        y, scale = ctx.saved_tensors
        g = gradients[0]
        along = (g * y).mean((2, 3), keepdim=True)
        return scale * (g - g.mean((2, 3), keepdim=True) - y * along)


class _Crop(torch.autograd.Function):
    """A slice whose adjoint is a padding."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, height: int, width: int) -> Tensor:
        ctx.pad = (0, x.shape[3] - width, 0, x.shape[2] - height)
        return x[:, :, :height, :width].clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        return functional.pad(gradients[0], ctx.pad), None, None


class LeakyReLU(nn.Module):
    """max(x, slope x)."""

    def __init__(self, slope: float) -> None:
        super().__init__()
        self.slope = slope

    def forward(self, x: Tensor) -> Tensor:
        return _LeakyReLU.apply(x, self.slope)


class InstanceNorm(nn.Module):
    """Each channel of each picture to mean 0 and variance 1, without weights (Ulyanov et al. 2016).

    A channel of a single pixel becomes 0.
    """

    def forward(self, x: Tensor) -> Tensor:
        return _InstanceNorm.apply(x)


def cropped(x: Tensor, like: Tensor) -> Tensor:
    """The first rows and columns of x [B, C, H, W], as many as `like` has."""
    height, width = like.shape[2:]
    return x if x.shape[2:] == like.shape[2:] else _Crop.apply(x, height, width)


def padded(x: Tensor, multiple: int) -> Tensor:
    """Zeros below and to the right of x [B, C, H, W], up to a multiple of that many pixels."""
    return functional.pad(x, (0, -x.shape[3] % multiple, 0, -x.shape[2] % multiple))
