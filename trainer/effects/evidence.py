"""What an effect sees of the captures when it looks for its starting values."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from trainer.captures.batches import Batch
from trainer.prediction.scene import Scene


@dataclass(frozen=True)
class Evidence:
    """One colour and plane: its scene, the captures, and what the model predicts for them [B, h, w], counts."""

    scene: Scene
    batch: Batch
    prediction: Tensor
