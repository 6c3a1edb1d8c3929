"""How a network is trained: its architecture, its losses and its optimiser, under a name.

The loss of Chakravarthula et al. 2020 is l1 + perceptual + adversarial ("published" below). An ablation is that recipe
with one thing changed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from firmware_iface.errors import InputError, nearest
from trainer.networks.approximator import FULL_FILTERS

STEPS = 40000  # Chakravarthula et al. 2020


@dataclass(frozen=True)
class Recipe:
    """Architecture, losses and optimiser of a training.

    Attributes
    ----------
    network : str
        One of `trainer.networks.approximator.NETWORKS`.
    filters : int
        Channels of its first layer.
    l1, perceptual, adversarial, matching : float
        Weights of the losses, of pictures 0 .. 1; matching is of the discriminator's features.
    conditional : bool
        Whether the discriminator sees the network's input too.
    critics : int
        Discriminators, each at half the size of the one before.
    receptive : int, pixels
        Side of the patch that each of their judgements sees, 94 or 70.
    cross_entropy : bool
        Whether the adversarial loss is the logistic one (Isola et al. 2017), not least squares (Mao et al. 2017).
    rate, betas : float, (float, float)
        Of Adam.
    """

    network: str = "published"
    filters: int = FULL_FILTERS["published"]
    l1: float = 100.0
    perceptual: float = 10.0
    adversarial: float = 1.0
    matching: float = 0.0
    conditional: bool = True
    critics: int = 1
    receptive: int = 94
    cross_entropy: bool = False
    rate: float = 2e-4
    betas: tuple[float, float] = (0.5, 0.999)


_PUBLISHED = Recipe()
_PLAIN = replace(_PUBLISHED, perceptual=0.0, adversarial=0.0)
RECIPES: dict[str, Recipe] = {
    "published": _PUBLISHED,
    "published_unconditional": replace(_PUBLISHED, conditional=False),
    "published_no_l1": replace(_PUBLISHED, l1=0.0),
    "published_no_perceptual": replace(_PUBLISHED, perceptual=0.0),
    "published_no_adversarial": replace(_PUBLISHED, adversarial=0.0),
    "published_l1_only": _PLAIN,
    "unet": replace(_PLAIN, network="unet", filters=FULL_FILTERS["unet"]),
    "pix2pix": replace(
        _PUBLISHED, network="pix2pix", filters=FULL_FILTERS["pix2pix"], perceptual=0.0, receptive=70,
        cross_entropy=True,
    ),
    "pix2pixhd": replace(
        _PUBLISHED, network="pix2pixhd", filters=FULL_FILTERS["pix2pixhd"], l1=0.0, matching=10.0, critics=2,
        receptive=70,
    ),
    "compact": replace(_PLAIN, network="compact", filters=FULL_FILTERS["compact"], rate=3e-3, betas=(0.9, 0.999)),
}  # fmt: skip


def recipe_named(name: str) -> Recipe:
    """The recipe of that name.

    Raises
    ------
    InputError
        For an unknown name, with the nearest known one.
    """
    if name not in RECIPES:
        raise InputError(f"there is no network '{name}': {nearest(name, RECIPES)}")
    return RECIPES[name]
