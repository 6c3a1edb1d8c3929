"""The U-Net that the published network is compared with (Ronneberger et al. 2015).

It has half the filters of the original, and padding keeps the borders.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.networks.layers import cropped, padded


class UNet(nn.Module):
    """Two 3 x 3 convolutions a level, five levels, max pooling; filters 32 is half of the original."""

    def __init__(self, filters: int = 32, planes: int = 3) -> None:
        super().__init__()
        widths = [filters * 2**level for level in range(5)]
        self.down, self.widen, self.up = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        before = planes
        for width in widths:
            self.down.append(_twice(before, width))
            before = width
        for width in widths[-2::-1]:
            self.widen.append(nn.ConvTranspose2d(before, width, 2, 2))
            self.up.append(_twice(2 * width, width))
            before = width
        self.last = nn.Conv2d(before, planes, 1)

    def forward(self, x: Tensor) -> Tensor:
        h, skips = padded(x, 16), []
        for level, down in enumerate(self.down):
            h = down(functional.max_pool2d(h, 2) if level else h)
            skips.append(h)
        skips.pop()
        for widen, up in zip(self.widen, self.up, strict=True):
            h = up(torch.cat((skips.pop(), widen(h)), 1))
        return cropped(self.last(h), x)


def _twice(before: int, width: int) -> nn.Sequential:
    first, second = nn.Conv2d(before, width, 3, 1, 1), nn.Conv2d(width, width, 3, 1, 1)
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU())
