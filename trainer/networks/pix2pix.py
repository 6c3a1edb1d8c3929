"""The Pix2Pix generator that the published network is compared with (Isola et al. 2017): eight levels, with dropout."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.networks.layers import InstanceNorm, LeakyReLU, cropped, padded


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
        h, skips = padded(x, 256), []
        for down in self.down:
            h = down(h)
            skips.append(h)
        skips.pop()
        for up in self.up:
            h = torch.cat((skips.pop(), up(h)), 1)
        return torch.tanh(cropped(self.last(functional.relu(h)), x))
