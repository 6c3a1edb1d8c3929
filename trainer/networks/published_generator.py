"""The generator of Chakravarthula et al. 2020 (Fig. 14), here called the published network."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.networks.layers import InstanceNorm, LeakyReLU, cropped

SLOPE = 0.02
FILTERS = 64
_ENCODER = (1, 2, 4, 8, 8, 8, 8, 8)  # channels of each layer, in units of `filters`
_DECODER = (8, 8, 8, 8, 4, 2, 1, 0.5)
_WITHOUT_NORM = 2  # encoder layers from the front, and decoder layers from the end, without instance norm


class Generator(nn.Module):
    """Irradiance [B, C, H, W] to planes of any sign, [B, C, H, W].

    Strided layers round sizes up, and the decoder is cut to each skip, so any size from 1 x 1 on is possible.

    Parameters
    ----------
    filters : int
        Channels of the first layer, a multiple of 2; 64 in the paper.
    planes : int
        Colours C; 3 in the paper.
    """

    def __init__(self, filters: int = FILTERS, planes: int = 3) -> None:
        super().__init__()
        down = [round(filters * n) for n in _ENCODER]
        up = [round(filters * n) for n in _DECODER]
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        before = planes
        for level, channels in enumerate(down):
            layers: list[nn.Module] = [nn.Conv2d(before, channels, 5, 2, 2)]
            layers += [InstanceNorm()] if level >= _WITHOUT_NORM else []
            self.down.append(nn.Sequential(*layers, LeakyReLU(SLOPE)))
            before = channels
        for level, channels in enumerate(up):
            layers = [nn.ConvTranspose2d(before, channels, 4, 2, 1)]
            layers += [InstanceNorm()] if level < len(up) - _WITHOUT_NORM else []
            layers += [LeakyReLU(SLOPE)] if level < len(up) - 1 else []
            self.up.append(nn.Sequential(*layers))
            before = channels + (down[-2 - level] if level < len(up) - 1 else 0)
        self.last = nn.Conv2d(before, planes, 4)

    def forward(self, x: Tensor) -> Tensor:
        skips = [x]
        for down in self.down:
            skips.append(down(skips[-1]))
        h = skips.pop()
        for up in self.up:
            skip = skips.pop()
            h = cropped(up(h), skip)
            h = torch.cat((h, skip), 1) if skips else h
        return self.last(functional.pad(h, (1, 2, 1, 2)))
