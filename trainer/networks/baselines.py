"""Generators that the published one was compared with: U-Net, Pix2Pix, Pix2PixHD.

U-Net: Ronneberger et al. 2015 with half the filters and borders kept by padding. Pix2Pix: Isola et al. 2017, the
eight-level generator with dropout. Pix2PixHD: Wang et al. 2018, the global generator with 32 filters. Sizes that
strides do not divide are padded and cut again.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.networks.layers import InstanceNorm, LeakyReLU, cropped


def _padded(x: Tensor, multiple: int) -> Tensor:
    """Zeros below and to the right, up to a multiple of that many pixels."""
    return functional.pad(x, (0, -x.shape[3] % multiple, 0, -x.shape[2] % multiple))


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
        h, skips = _padded(x, 16), []
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


class Pix2Pix(nn.Module):
    """k4 s2 encoder and decoder of eight levels, instance norm, dropout in three levels, tanh at the end."""

    def __init__(self, filters: int = 64, planes: int = 3) -> None:
        super().__init__()
        widths = [filters * n for n in (1, 2, 4, 8, 8, 8, 8, 8)]
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        before = planes
        for level, width in enumerate(widths):
            layers: list[nn.Module] = [LeakyReLU(0.2)] if level else []
            layers.append(nn.Conv2d(before, width, 4, 2, 1))
            layers += [InstanceNorm()] if 0 < level < 7 else []
            self.down.append(nn.Sequential(*layers))
            before = width
        for level, width in enumerate(widths[-2::-1]):
            layers = [nn.ReLU(), nn.ConvTranspose2d(before, width, 4, 2, 1), InstanceNorm()]
            layers += [nn.Dropout(0.5)] if 1 <= level <= 3 else []
            self.up.append(nn.Sequential(*layers))
            before = 2 * width
        self.last = nn.ConvTranspose2d(before, planes, 4, 2, 1)

    def forward(self, x: Tensor) -> Tensor:
        h, skips = _padded(x, 256), []
        for down in self.down:
            h = down(h)
            skips.append(h)
        skips.pop()
        for up in self.up:
            h = torch.cat((skips.pop(), up(h)), 1)
        return torch.tanh(cropped(self.last(functional.relu(h)), x))


class Pix2PixHD(nn.Module):
    """The global generator: 7 x 7 convolution, four halvings, nine residual blocks, four doublings, tanh."""

    def __init__(self, filters: int = 32, planes: int = 3) -> None:
        super().__init__()
        widths = [filters * 2**level for level in range(5)]
        layers: list[nn.Module] = [nn.Conv2d(planes, filters, 7, 1, 3, padding_mode="replicate")]
        layers += [InstanceNorm(), nn.ReLU()]
        for before, width in pairwise(widths):
            layers += [nn.Conv2d(before, width, 3, 2, 1), InstanceNorm(), nn.ReLU()]
        layers += [_Residual(widths[-1]) for _ in range(9)]
        for before, width in pairwise(widths[::-1]):
            layers += [nn.ConvTranspose2d(before, width, 3, 2, 1, 1), InstanceNorm(), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.last = nn.Conv2d(filters, planes, 7, 1, 3, padding_mode="replicate")

    def forward(self, x: Tensor) -> Tensor:
        return torch.tanh(cropped(self.last(self.layers(_padded(x, 16))), x))


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        first, second = (nn.Conv2d(width, width, 3, 1, 1, padding_mode="replicate") for _ in range(2))
        self.layers = nn.Sequential(first, InstanceNorm(), nn.ReLU(), second, InstanceNorm())

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)
