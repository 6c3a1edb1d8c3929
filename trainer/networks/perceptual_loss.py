"""The perceptual loss: a distance between pictures in VGG-19's features (Johnson et al. 2016).

Pictures are [B, 3, H, W], 0 .. 1, display-encoded (here: amplitude over the amplitude of white).
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from trainer.networks.pretrained_features import VGG19, PretrainedFeatures, load_features
from trainer.networks.weight_files import read_weights

# conv1_2, 2_2, 3_2, 4_2, 5_2, as in Chen and Koltun 2017, whose weights file it is
VGG_TAPS = (1, 3, 5, 9, 13)


class PerceptualLoss(nn.Module):
    """Mean over VGG-19's layers of the mean absolute difference of features, over the target's mean feature.

    It is relative to the target, so that it does not depend on the scale of the weights.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, features: PretrainedFeatures, mean: Tensor, scale: Tensor) -> None:
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


def read_perceptual_loss(path: Path) -> PerceptualLoss:
    """The perceptual loss with a weights file of VGG-19.

    Raises
    ------
    InputError
        As from `read_weights`, and where the weights do not fit VGG-19.
    """
    features = load_features(read_weights(path), VGG19, VGG_TAPS, path)
    if path.suffix.lower() == ".mat":  # trained on 0 .. 255 less the mean; torchvision's on normalised 0 .. 1
        return PerceptualLoss(
            features, torch.tensor([123.68, 116.779, 103.939]) / 255, torch.full((3,), 1 / 255)
        )
    return PerceptualLoss(features, torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225]))
