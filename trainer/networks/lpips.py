"""LPIPS, a learned distance between pictures (Zhang et al. 2018).

Pictures are [B, 3, H, W], 0 .. 1, display-encoded (here: amplitude over the amplitude of white).
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from firmware_iface.errors import InputError
from trainer.networks.pretrained_features import ALEXNET, VGG16, PretrainedFeatures, load_features
from trainer.networks.weight_files import read_weights

LPIPS_TAPS = {VGG16: (1, 3, 6, 9, 12), ALEXNET: (0, 1, 2, 3, 4)}
SMALLEST = 32  # pixels a side


class Lpips(nn.Module):
    """Learned perceptual distance of pictures, [B]: 0 for equal ones, about 1 for unlike ones."""

    mean: Tensor
    scale: Tensor

    def __init__(self, features: PretrainedFeatures, heads: list[Tensor]) -> None:
        super().__init__()
        self.features = features
        self.heads = nn.ParameterList(heads).requires_grad_(False)
        self.register_buffer("mean", torch.tensor([-0.030, -0.088, -0.188])[:, None, None])
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None])

    @torch.no_grad()
    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        features = [self.features((2 * x - 1 - self.mean) / self.scale) for x in (first, second)]
        total = first.new_zeros(first.shape[0])
        for a, b, head in zip(*features, self.heads, strict=True):
            difference = (_unit(a) - _unit(b)) ** 2
            total = total + (difference * head).sum(1).mean((1, 2))
        return total


def _unit(features: Tensor) -> Tensor:
    return features / (torch.sqrt((features**2).sum(1, keepdim=True)) + 1e-10)


def read_lpips(paths: list[Path]) -> Lpips:
    """LPIPS with the weights of one file, or of one with the backbone (AlexNet or VGG-16) and one with its heads.

    Raises
    ------
    InputError
        As from `read_weights`, and where the backbone or the heads do not fit.
    """
    where = " and ".join(map(str, paths))
    tensors = {name: value for path in paths for name, value in read_weights(path).items()}
    first = next((t for n, t in tensors.items() if t.ndim == 4 and not n.startswith("lin")), None)
    layout = ALEXNET if first is not None and first.shape[-1] == 11 else VGG16
    taps = LPIPS_TAPS[layout]
    features = load_features(tensors, layout, taps, where)
    widths = [features.convolutions()[tap].out_channels for tap in taps]
    heads = []
    for number, width in enumerate(widths):
        head = next(
            (t for n, t in tensors.items() if n.startswith(f"lin{number}.") and t.numel() == width), None
        )
        if head is None:
            raise InputError(
                f"{where}: head lin{number} with {width} weights is missing: name LPIPS's heads too"
            )
        heads.append(head.float().reshape(1, width, 1, 1))
    return Lpips(features, heads).eval()
