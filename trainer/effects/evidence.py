"""What an effect is given of the captures to find its starting values."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from trainer.captures.batches import Batch
from trainer.prediction.scene import Scene


@dataclass(frozen=True)
class Evidence:
    """Captures of one colour and plane, and the model's prediction for them.

    Attributes
    ----------
    scene : Scene
    batch : Batch
        The captures.
    prediction : Tensor [B, h, w], counts above black
    """

    scene: Scene
    batch: Batch
    prediction: Tensor
