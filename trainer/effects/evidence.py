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
    straight : Tensor [B, h, w], counts above black, or None
        What the camera would count if its response were straight, where it is bent and known.
    slope : Tensor [B, h, w] or None
        Change of `prediction` for one count more of `straight`.
    """

    scene: Scene
    batch: Batch
    prediction: Tensor
    straight: Tensor | None = None
    slope: Tensor | None = None

    def of(self, k: int) -> Evidence:
        """The evidence of capture k alone."""
        b = self.batch
        parts = {n: getattr(b, n)[k : k + 1] for n in ("ids", "gray", "signal", "mask", "noise", "exposure")}
        batch = replace(b, shown_before=lambda: b.shown_before()[k : k + 1], **parts)
        bent = (None if t is None else t[k : k + 1] for t in (self.straight, self.slope))
        return Evidence(self.scene, batch, self.prediction[k : k + 1], *bent)
