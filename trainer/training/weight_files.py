"""Which of the user's weight files serve in a training, and what is left out without them."""

from __future__ import annotations

from pathlib import Path

from trainer.networks.perceptual import read_lpips, read_perceptual
from trainer.training.recipe import Recipe
from trainer.training.train import Judges


def read_judges(vgg: Path | None, lpips: list[Path]) -> Judges:
    """The perceptual loss and LPIPS from weight files. Raises InputError where one cannot be used."""
    return Judges(read_perceptual(vgg) if vgg else None, read_lpips(lpips) if lpips else None)


def left_out(recipe: Recipe, judges: Judges) -> list[str]:
    """What a training lacks because a weights file was not named, a sentence each."""
    missing = []
    if recipe.perceptual and judges.perceptual is None:
        missing.append("the perceptual loss, which needs VGG-19's weights (--vgg FILE)")
    if judges.lpips is None:
        missing.append("1 - LPIPS, which needs its weights (--lpips FILE)")
    return missing
