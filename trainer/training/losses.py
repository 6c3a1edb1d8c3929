"""The losses of a training step, on display-encoded pictures: amplitude over the amplitude of white.

Where the measurement says nothing the picture is given the target's value, so nothing there has a gradient.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.networks.approximator import amplitude
from trainer.networks.perceptual import Perceptual
from trainer.networks.published import FILTERS, PatchDiscriminator
from trainer.training.recipe import Recipe


def picture(irradiance: Tensor, white: float) -> Tensor:
    """Irradiance as a picture, 1 at white and not cut there: amplitude over the amplitude of white."""
    return amplitude(irradiance) / white**0.5


def where_seen(ours: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """`ours` where the weight is 1, the target where it is 0."""
    return weight * ours + (1 - weight) * target


def three_planes(pictures: Tensor) -> Tensor:
    """Pictures [B, C, H, W] as networks for photographs take them, [B, 3, H, W]: one colour is shown as gray."""
    planes = pictures.shape[1]
    if planes == 1:
        return pictures.expand(-1, 3, -1, -1)
    return pictures if planes == 3 else functional.pad(pictures, (0, 0, 0, 0, 0, 3 - planes))


class Critic(nn.Module):
    """The discriminators of a recipe, each at half the size of the one before."""

    def __init__(self, recipe: Recipe, filters: int = FILTERS, planes: int = 3) -> None:
        super().__init__()
        published = recipe.receptive == 94
        self.conditional, self.cross_entropy = recipe.conditional, recipe.cross_entropy
        self.scales = nn.ModuleList(
            PatchDiscriminator(
                2 * planes if recipe.conditional else planes,
                filters,
                plain=2 if published else 1,
                slope=0.02 if published else 0.2,
                bounded=published,
            )
            for _ in range(recipe.critics)
        )

    def forward(self, shown: Tensor, condition: Tensor) -> list[list[Tensor]]:
        """Features of each scale, its judgement last."""
        x = torch.cat((condition, shown), 1) if self.conditional else shown
        seen = []
        for scale in self.scales:
            seen.append(scale.features(x))  # type: ignore[operator]
            x = functional.avg_pool2d(x, 2)
        return seen

    def loss(self, judged: Sequence[Sequence[Tensor]], real: bool) -> Tensor:
        """How far the judgements are from `real`, mean over patches and scales."""
        return torch.stack([self._one(scale[-1], real) for scale in judged]).mean()

    def _one(self, judgement: Tensor, real: bool) -> Tensor:
        wanted = torch.full_like(judgement, float(real))
        if self.cross_entropy:
            return functional.binary_cross_entropy_with_logits(judgement, wanted)
        return functional.mse_loss(judgement, wanted)


def matching_loss(ours: Sequence[Sequence[Tensor]], real: Sequence[Sequence[Tensor]]) -> Tensor:
    """Mean absolute difference of the discriminators' inner features (Wang et al. 2018)."""
    parts = [
        functional.l1_loss(a, b.detach())
        for mine, theirs in zip(ours, real, strict=True)
        for a, b in zip(mine[:-1], theirs[:-1], strict=True)
    ]
    return torch.stack(parts).mean()


def content_loss(recipe: Recipe, ours: Tensor, target: Tensor, perceptual: Perceptual | None) -> Tensor:
    """The weighted l1 and perceptual losses of pictures [B, C, H, W]."""
    total = recipe.l1 * functional.l1_loss(ours, target)
    if perceptual is not None and recipe.perceptual:
        total = total + recipe.perceptual * perceptual(three_planes(ours), three_planes(target))
    return total
