"""The losses of a training step, on display-encoded pictures: amplitude over the amplitude of white.

Where there is no measurement, the picture gets the target's value, so that it has no gradient there.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from trainer.networks.approximator import amplitude
from trainer.networks.perceptual_loss import PerceptualLoss
from trainer.training.recipe import Recipe


def display_encoded(irradiance: Tensor, white: float) -> Tensor:
    """Irradiance as a picture: amplitude over the amplitude of white, so 1 at white; brighter values are kept."""
    return amplitude(irradiance) / white**0.5


def where_measured(ours: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """`ours` where the weight is 1, the target where it is 0."""
    return weight * ours + (1 - weight) * target


def three_planes(pictures: Tensor) -> Tensor:
    """Pictures [B, C, H, W] as networks for photographs take them, [B, 3, H, W]: one colour becomes gray."""
    planes = pictures.shape[1]
    if planes == 1:
        return pictures.expand(-1, 3, -1, -1)
    return pictures if planes == 3 else functional.pad(pictures, (0, 0, 0, 0, 0, 3 - planes))


def adversarial_loss(judged: Sequence[Sequence[Tensor]], real: bool, cross_entropy: bool = False) -> Tensor:
    """How far a discriminator's judgements are from `real`, mean over patches and scales.

    Parameters
    ----------
    judged : sequence of sequence of Tensor
        Result of `Discriminator`: features of each scale, its judgement last.
    real : bool
        What the judgements should say.
    cross_entropy : bool
        The logistic loss (Isola et al. 2017) instead of least squares (Mao et al. 2017).
    """
    distance = functional.binary_cross_entropy_with_logits if cross_entropy else functional.mse_loss
    judgements = [scale[-1] for scale in judged]
    return torch.stack([distance(one, torch.full_like(one, float(real))) for one in judgements]).mean()


def matching_loss(ours: Sequence[Sequence[Tensor]], real: Sequence[Sequence[Tensor]]) -> Tensor:
    """Mean absolute difference of the discriminators' inner features (Wang et al. 2018)."""
    parts = [
        functional.l1_loss(a, b.detach())
        for mine, others in zip(ours, real, strict=True)
        for a, b in zip(mine[:-1], others[:-1], strict=True)
    ]
    return torch.stack(parts).mean()


def content_loss(recipe: Recipe, ours: Tensor, target: Tensor, perceptual: PerceptualLoss | None) -> Tensor:
    """The weighted l1 and perceptual losses of pictures [B, C, H, W]."""
    total = recipe.l1 * functional.l1_loss(ours, target)
    if perceptual is not None and recipe.perceptual:
        total = total + recipe.perceptual * perceptual(three_planes(ours), three_planes(target))
    return total
