"""The aberration approximator as it was published: generator and discriminator of Chakravarthula et al. 2020.

Seed Fig. 14 gives their layers. Its table has stride 2 in all six layers of the discriminator, which would see
190 x 190 pixels; its text says 94 x 94, which the same six layers see with stride 2 in the first three only, as
in the PatchGAN that it descends from (Isola et al. 2017). The text is followed.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.networks.layers import InstanceNorm, LeakyReLU, cropped

SLOPE = 0.02
FILTERS = 64
_ENCODER = (1, 2, 4, 8, 8, 8, 8, 8)  # channels of each layer, in units of `filters`
_DECODER = (8, 8, 8, 8, 4, 2, 1, 0.5)
_BARE = 2  # encoder layers from the front, and decoder layers from the end, without instance norm


class Generator(nn.Module):
    """Irradiance [B, C, H, W] to planes of any sign, [B, C, H, W].

    filters : channels of the first layer, a multiple of 2; 64 as published. planes : C, 3 as published
    Strided layers round sizes up, and the decoder is cut to each skip, so any size from 1 x 1 on will do.
    """

    def __init__(self, filters: int = FILTERS, planes: int = 3) -> None:
        super().__init__()
        down = [round(filters * n) for n in _ENCODER]
        up = [round(filters * n) for n in _DECODER]
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        before = planes
        for level, channels in enumerate(down):
            layers: list[nn.Module] = [nn.Conv2d(before, channels, 5, 2, 2)]
            layers += [InstanceNorm()] if level >= _BARE else []
            self.down.append(nn.Sequential(*layers, LeakyReLU(SLOPE)))
            before = channels
        for level, channels in enumerate(up):
            layers = [nn.ConvTranspose2d(before, channels, 4, 2, 1)]
            layers += [InstanceNorm()] if level < len(up) - _BARE else []
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


class PatchDiscriminator(nn.Module):
    """How real each patch of a picture looks, given the ideal picture: [B, C, H, W] to [B, 1, h, w].

    planes : 6 where the condition is stacked on the picture, 3 without one
    strided, plain : layers of stride 2 and of stride 1 before the last one, which has stride 1;
    three and two see 94 x 94 pixels, as published, three and one 70 x 70 (Isola et al. 2017)
    slope, bounded : of the leaky rectifiers, and whether one ends the network too, as published
    """

    def __init__(
        self,
        planes: int = 6,
        filters: int = FILTERS,
        strided: int = 3,
        plain: int = 2,
        slope: float = SLOPE,
        bounded: bool = True,
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = planes
        for level in range(strided + plain):
            channels = filters * min(2**level, 8)
            layers.append(nn.Conv2d(before, channels, 4, 2 if level < strided else 1, 1))
            layers += [InstanceNorm()] if level else []
            layers.append(LeakyReLU(slope))
            before = channels
        layers.append(nn.Conv2d(before, 1, 4, 1, 1))
        self.layers = nn.Sequential(*layers, *([LeakyReLU(slope)] if bounded else []))

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x)

    def features(self, x: Tensor) -> list[Tensor]:
        """What each rectifier gives, the last one's judgement last."""
        seen = []
        for layer in self.layers:
            x = layer(x)
            if isinstance(layer, LeakyReLU):
                seen.append(x)
        return seen if isinstance(self.layers[-1], LeakyReLU) else [*seen, x]
