"""The discriminator of the adversarial loss: does a picture look like a camera's?

It follows Chakravarthula et al. 2020. The table in Fig. 14 there has stride 2 in all six layers, which would see
190 x 190 pixels; the text says 94 x 94, which the same six layers see with stride 2 in the first three only, as in the
PatchGAN that it descends from (Isola et al. 2017). The text is followed.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.networks.layers import InstanceNorm, LeakyReLU
from trainer.networks.published_generator import FILTERS, SLOPE

PUBLISHED_PATCH = 94  # pixels, side


class Discriminator(nn.Module):
    """Patch discriminators of a picture at one or several scales, each at half the size of the one before.

    Parameters
    ----------
    filters : int
        Channels of the first layer.
    planes : int
        Colours of a picture.
    patch : int, pixels
        Side of the patch that each judgement sees: 94 (Chakravarthula et al. 2020) or 70 (Isola et al. 2017).
    scales : int
        Number of patch discriminators.
    conditional : bool
        Whether it sees the network's input next to the picture.
    """

    def __init__(
        self,
        filters: int = FILTERS,
        planes: int = 3,
        patch: int = PUBLISHED_PATCH,
        scales: int = 1,
        conditional: bool = True,
    ) -> None:
        super().__init__()
        published = patch == PUBLISHED_PATCH
        self.conditional = conditional
        self.scales = nn.ModuleList(
            PatchDiscriminator(
                2 * planes if conditional else planes,
                filters,
                plain=2 if published else 1,
                slope=SLOPE if published else 0.2,
                bounded=published,
            )
            for _ in range(scales)
        )

    def forward(self, picture: Tensor, condition: Tensor) -> list[list[Tensor]]:
        """Features of each scale, its judgement last."""
        x = torch.cat((condition, picture), 1) if self.conditional else picture
        found = []
        for scale in self.scales:
            found.append(scale.features(x))  # type: ignore[operator]
            x = functional.avg_pool2d(x, 2)
        return found


class PatchDiscriminator(nn.Module):
    """How real each patch of a picture looks: [B, planes, H, W] to [B, 1, h, w].

    Parameters
    ----------
    planes : int
        6 where the condition is stacked on the picture, 3 without one.
    filters : int
        Channels of the first layer.
    strided, plain : int
        Layers of stride 2 and of stride 1 before the last one, which has stride 1. Three and two see 94 x 94
        pixels (Chakravarthula et al. 2020), three and one 70 x 70 (Isola et al. 2017).
    slope : float
        Slope of the leaky rectifiers.
    bounded : bool
        Whether a rectifier ends the network too, as in the paper.
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
        """The result of each rectifier, and the judgement of the last layer at the end."""
        results = []
        for layer in self.layers:
            x = layer(x)
            if isinstance(layer, LeakyReLU):
                results.append(x)
        return results if isinstance(self.layers[-1], LeakyReLU) else [*results, x]
