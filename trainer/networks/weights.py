"""Features of networks that others trained: VGG and AlexNet, from weight files that the user names.

Read are PyTorch files (tensors alone: nothing in them is run), safetensors, and the .mat files of MatConvNet.
What counts are the convolutions in their order, so files of torchvision, of LPIPS and of MatConvNet all serve.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
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


class Features(nn.Module):
    """Rectified convolutions of a frozen network, at chosen places: [B, 3, H, W] to a list of [B, C, h, w].

    layout : its layers; taps : which convolutions' results are given, counted from 0
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
        seen: list[Tensor] = []
        count = 0
        for layer in self.layers:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                seen += [x] if count in self.taps else []
                count += 1
            if len(seen) == len(self.taps):
                break
        return seen

    def convolutions(self) -> list[nn.Conv2d]:
        """Its convolutions, in order."""
        return [layer for layer in self.layers if isinstance(layer, nn.Conv2d)]


def load_features(
    tensors: Mapping[str, Tensor], layout: Sequence[Layer], taps: Sequence[int], path: Any
) -> Features:
    """Frozen features with the weights of a file's tensors. Raises InputError where they do not fit."""
    features = Features(layout, taps)
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


def read_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a weights file, by name. Raises InputError where it cannot be read."""
    readers = {".safetensors": _safetensors, ".mat": _matconvnet, ".pt": _pytorch, ".pth": _pytorch}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is not a kind of weights file that is read here: give {', '.join(readers)}")
    if not path.is_file():
        raise InputError(f"{path} is missing: name the weights file that you have")
    return reader(path)


def _safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} cannot be read as safetensors ({error}): copy it again") from None


def _pytorch(path: Path) -> dict[str, Tensor]:
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the reader that runs nothing raises whatever it stumbles over
        reason = (str(error).splitlines() or [type(error).__name__])[0][:80]
        raise InputError(
            f"{path} cannot be read as a PyTorch file of tensors alone ({reason}): save its state dict as safetensors"
        ) from None
    if not isinstance(found, Mapping):
        raise InputError(f"{path} holds no table of tensors: save a state dict")
    return {str(name): value for name, value in found.items() if isinstance(value, Tensor)}


def _matconvnet(path: Path) -> dict[str, Tensor]:
    import numpy as np
    import scipy.io

    try:
        layers = np.atleast_1d(scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)["layers"])
    except Exception as error:  # SciPy's reader has no common one
        raise InputError(f"{path} is not a .mat of MatConvNet ({error}): name another weights file") from None
    tensors: dict[str, Tensor] = {}
    for number, layer in enumerate(layers):
        if getattr(layer, "type", "") != "conv":
            continue
        kernel, bias = layer.weights if hasattr(layer, "weights") else (layer.filters, layer.biases)
        # [row, column, in, out], of which squeezing has taken axes of length 1 only in layers not used here
        if kernel.ndim == 4:
            tensors[f"{number}.weight"] = torch.tensor(
                np.transpose(kernel, (3, 2, 0, 1)), dtype=torch.float32
            )
            tensors[f"{number}.bias"] = torch.tensor(np.atleast_1d(bias), dtype=torch.float32)
    return tensors
