"""Distances between pictures as networks see them: VGG-19's features, and LPIPS (Zhang et al. 2018).

Pictures are [B, 3, H, W], 0 .. 1, display-encoded (here: amplitude over the amplitude of white).
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from firmware_iface.errors import InputError
from trainer.networks.weights import ALEXNET, VGG16, VGG19, Features, load_features, read_weights

VGG_TAPS = (
    1,
    3,
    5,
    9,
    13,
)  # conv1_2, 2_2, 3_2, 4_2, 5_2, as in Chen and Koltun 2017, whose weights file it is
LPIPS_TAPS = {VGG16: (1, 3, 6, 9, 12), ALEXNET: (0, 1, 2, 3, 4)}
SMALLEST = 32  # pixels a side


class Perceptual(nn.Module):
    """Mean over VGG-19's layers of the mean absolute difference of features, over the target's mean feature.

    Relative to the target, so it means the same for weights of any scale.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, features: Features, mean: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.features = features
        self.register_buffer("mean", mean[:, None, None])
        self.register_buffer("scale", scale[:, None, None])

    def forward(self, picture: Tensor, target: Tensor) -> Tensor:
        ours = self.features((picture - self.mean) / self.scale)
        with torch.no_grad():
            theirs = self.features((target - self.mean) / self.scale)
        parts = [(a - b).abs().mean() / (b.abs().mean() + 1e-12) for a, b in zip(ours, theirs, strict=True)]
        return torch.stack(parts).mean()


def read_perceptual(path: Path) -> Perceptual:
    """The perceptual distance with a weights file of VGG-19. Raises InputError as `read_weights` does."""
    features = load_features(read_weights(path), VGG19, VGG_TAPS, path)
    if path.suffix.lower() == ".mat":  # trained on 0 .. 255 less the mean; torchvision's on normalised 0 .. 1
        return Perceptual(features, torch.tensor([123.68, 116.779, 103.939]) / 255, torch.full((3,), 1 / 255))
    return Perceptual(features, torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225]))


class Lpips(nn.Module):
    """Learned perceptual distance: 0 for equal pictures, about 1 for unlike ones; one number a picture, [B]."""

    mean: Tensor
    scale: Tensor

    def __init__(self, features: Features, heads: list[Tensor]) -> None:
        super().__init__()
        self.features = features
        self.heads = nn.ParameterList(heads).requires_grad_(False)
        self.register_buffer("mean", torch.tensor([-0.030, -0.088, -0.188])[:, None, None])
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None])

    @torch.no_grad()
    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        seen = [self.features((2 * x - 1 - self.mean) / self.scale) for x in (first, second)]
        total = first.new_zeros(first.shape[0])
        for a, b, head in zip(*seen, self.heads, strict=True):
            difference = (_unit(a) - _unit(b)) ** 2
            total = total + (difference * head).sum(1).mean((1, 2))
        return total


def _unit(features: Tensor) -> Tensor:
    return features / (torch.sqrt((features**2).sum(1, keepdim=True)) + 1e-10)


def read_lpips(paths: list[Path]) -> Lpips:
    """LPIPS with the weights of one file, or of one with the backbone (AlexNet or VGG-16) and one with its heads.

    Raises InputError as `read_weights` does, and where the heads do not fit.
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
