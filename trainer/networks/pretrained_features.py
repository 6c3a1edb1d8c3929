"""VGG-19, VGG-16 and AlexNet as fixed features of a picture, with weights that others trained.

Weights are assigned to the convolutions in their order, so files of torchvision, of LPIPS and of MatConvNet all work.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from firmware_iface.errors import InputError

Layer = tuple[int, int, int, int] | str  # (channels, kernel, stride, padding), or "pool"

_POOL = "pool"


def _vgg(*convolutions: int) -> tuple[Layer, ...]:
    layers: list[Layer] = []
    for width, count in zip((64, 128, 256, 512, 512), convolutions, strict=True):
        layers += [(width, 3, 1, 1)] * count + [_POOL]
    return tuple(layers)


VGG19 = _vgg(2, 2, 4, 4, 4)
VGG16 = _vgg(2, 2, 3, 3, 3)
ALEXNET: tuple[Layer, ...] = (
    (64, 11, 4, 2), _POOL, (192, 5, 1, 2), _POOL, (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1),
)  # fmt: skip


class PretrainedFeatures(nn.Module):
    """Rectified convolutions of a frozen network, at chosen places: [B, 3, H, W] to a list of [B, C, h, w].

    Parameters
    ----------
    layout : sequence of Layer
        Layers of the network.
    taps : sequence of int
        The convolutions whose results are returned, counted from 0.
    """

    def __init__(self, layout: Sequence[Layer], taps: Sequence[int]) -> None:
        super().__init__()
        self.taps = tuple(taps)
        pool = 3 if layout is ALEXNET else 2
        layers: list[nn.Module] = []
        before = 3
        for layer in layout:
            if isinstance(layer, str):
                layers.append(nn.MaxPool2d(pool, 2))
                continue
            width, kernel, stride, padding = layer
            layers += [nn.Conv2d(before, width, kernel, stride, padding), nn.ReLU()]
            before = width
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> list[Tensor]:
        results: list[Tensor] = []
        count = 0
        for layer in self.layers:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                results += [x] if count in self.taps else []
                count += 1
            if len(results) == len(self.taps):
                break
        return results

    def convolutions(self) -> list[nn.Conv2d]:
        """Its convolutions, in order."""
        return [layer for layer in self.layers if isinstance(layer, nn.Conv2d)]


def load_features(
    tensors: Mapping[str, Tensor], layout: Sequence[Layer], taps: Sequence[int], path: Any
) -> PretrainedFeatures:
    """Frozen features with the weights of a file's tensors.

    Parameters
    ----------
    tensors : mapping of str to Tensor
        Weights and biases, by name.
    layout, taps
        As of `PretrainedFeatures`.
    path : object
        The file, for messages.

    Raises
    ------
    InputError
        Where the tensors do not fit the layout.
    """
    features = PretrainedFeatures(layout, taps)
    convolutions = features.convolutions()
    names = [
        n for n, t in tensors.items() if t.ndim == 4 and n.endswith("weight") and not n.startswith("lin")
    ]
    names.sort(key=lambda name: [int(part) for part in re.findall(r"\d+", name)])
    if len(names) < len(convolutions):
        raise InputError(
            f"{path} has {len(names)} convolutions and {len(convolutions)} are needed: name another weights file"
        )
    for convolution, name in zip(convolutions, names, strict=False):
        weight, bias = tensors[name], tensors.get(f"{name.removesuffix('weight')}bias")
        if weight.shape != convolution.weight.shape or bias is None:
            raise InputError(
                f"{path}: {name} has the shape {tuple(weight.shape)} and {tuple(convolution.weight.shape)}, with a "
                "bias, is needed: name another weights file"
            )
        convolution.weight.data, convolution.bias.data = weight.float(), bias.float()  # type: ignore[union-attr]
    return features.requires_grad_(False).eval()
