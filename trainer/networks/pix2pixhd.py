"""Pix2PixHD, a network that the published one is compared with (Wang et al. 2018): its global generator, 32 filters."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from trainer.networks.layers import InstanceNorm, cropped, padded


class Pix2PixHD(nn.Module):
    """The global generator: 7 x 7 convolution, four halvings, nine residual blocks, four doublings, tanh."""

    def __init__(self, filters: int = 32, planes: int = 3) -> None:
        super().__init__()
        widths = [filters * 2**level for level in range(5)]
        layers: list[nn.Module] = [nn.Conv2d(planes, filters, 7, 1, 3, padding_mode="replicate")]
        layers += [InstanceNorm(), nn.ReLU()]
        for before, width in pairwise(widths):
            layers += [nn.Conv2d(before, width, 3, 2, 1), InstanceNorm(), nn.ReLU()]
        layers += [_ResidualBlock(widths[-1]) for _ in range(9)]
        for before, width in pairwise(widths[::-1]):
            layers += [nn.ConvTranspose2d(before, width, 3, 2, 1, 1), InstanceNorm(), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.last = nn.Conv2d(filters, planes, 7, 1, 3, padding_mode="replicate")

    def forward(self, x: Tensor) -> Tensor:
        return torch.tanh(cropped(self.last(self.layers(padded(x, 16))), x))


class _ResidualBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        first, second = (nn.Conv2d(width, width, 3, 1, 1, padding_mode="replicate") for _ in range(2))
        self.layers = nn.Sequential(first, InstanceNorm(), nn.ReLU(), second, InstanceNorm())

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)
