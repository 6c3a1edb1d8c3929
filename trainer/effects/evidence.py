"""What an effect is given of the captures to find its starting values."""

from __future__ import annotations

from dataclasses import dataclass, replace

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

    def of(self, k: int) -> Evidence:
        """The evidence of capture k alone."""
        b = self.batch
        parts = {n: getattr(b, n)[k : k + 1] for n in ("ids", "gray", "signal", "mask", "noise", "exposure")}
        batch = replace(b, shown_before=lambda: b.shown_before()[k : k + 1], **parts)
        return Evidence(self.scene, batch, self.prediction[k : k + 1])
