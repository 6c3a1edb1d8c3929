"""The networks of others that a training uses: the perceptual loss and LPIPS, from the user's weight files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from trainer.networks.lpips import Lpips, read_lpips
from trainer.networks.perceptual_loss import PerceptualLoss, read_perceptual_loss
from trainer.training.recipe import Recipe


@dataclass(frozen=True)
class PretrainedNetworks:
    """Networks with weights that others trained; None where the user named no file.

    Attributes
    ----------
    perceptual : PerceptualLoss or None
        For the loss.
    lpips : Lpips or None
        For metrics.
    """

    perceptual: PerceptualLoss | None = None
    lpips: Lpips | None = None


def read_pretrained(vgg: Path | None, lpips: list[Path]) -> PretrainedNetworks:
    """The perceptual loss and LPIPS from weight files.

    Raises
    ------
    InputError
        Where a file cannot be used.
    """
    return PretrainedNetworks(
        read_perceptual_loss(vgg) if vgg else None, read_lpips(lpips) if lpips else None
    )


def left_out(recipe: Recipe, pretrained: PretrainedNetworks) -> list[str]:
    """What a training lacks because a weights file was not named, a sentence each."""
    missing = []
    if recipe.perceptual and pretrained.perceptual is None:
        missing.append("the perceptual loss, which needs VGG-19's weights (--vgg FILE)")
    if pretrained.lpips is None:
        missing.append("1 - LPIPS, which needs its weights (--lpips FILE)")
    return missing
