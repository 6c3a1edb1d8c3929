"""The settings of the hardware-in-the-loop cycle, and when a picture is good enough."""

from __future__ import annotations

from dataclasses import dataclass, field

from trainer.cycle.phase_retrieval import ITERATIONS
from trainer.training.image_metrics import ImageMetrics
from trainer.training.pretrained_networks import PretrainedNetworks
from trainer.training.recipe import Recipe

GOOD_LPIPS, GOOD_SSIM = 0.5, 0.95  # 1 - LPIPS is from the paper; SSIM is used where LPIPS has no weights


@dataclass(frozen=True)
class CycleSettings:
    """How a cycle is run.

    Attributes
    ----------
    rounds : int
        K.
    recipe : Recipe
        Of each training.
    steps : int
        Of each training; with 0 there is no network.
    iterations : int
        Of each phase retrieval.
    method : str
        Phase retrieval through the model alone, before there is a D.
    good : float or None
        1 - LPIPS (SSIM without weights) above which a picture is left alone; None: GOOD_LPIPS, GOOD_SSIM.
    online : bool
        Whether each picture has its own D and its own field.
    seed : int
        Of each training.
    pretrained : PretrainedNetworks
        The perceptual loss and LPIPS.
    """

    rounds: int
    recipe: Recipe
    steps: int
    iterations: int = ITERATIONS
    method: str = "hardware_in_the_loop"
    good: float | None = None
    online: bool = False
    seed: int = 0
    pretrained: PretrainedNetworks = field(default_factory=PretrainedNetworks)

    def good_enough(self, metrics: ImageMetrics) -> bool:
        """Whether a picture is left alone."""
        if metrics.one_minus_lpips is not None:
            return metrics.one_minus_lpips > (GOOD_LPIPS if self.good is None else self.good)
        return metrics.ssim > (GOOD_SSIM if self.good is None else self.good)
