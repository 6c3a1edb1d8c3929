"""What work has brought back on the model that is shown: the verdict, the candidates, and what is gained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from trainer.diagnosis.diagnosis import Diagnosis
from trainer.diagnosis.previews import CandidatePreview
from trainer.diagnosis.ranking import RankedEffect
from trainer.model.model import Model


class Results:
    """Results that belong to the shown model, and the last displayed picture.

    Attributes
    ----------
    diagnosis : Diagnosis or None
    ranking : tuple of RankedEffect
        The diagnosis' own, and effects of the user's that were tried since.
    previews : dict of str to CandidatePreview
        By effect.
    verdict : str
        The sentence of the last result.
    gain : GainPicture or None
    """

    def __init__(self) -> None:
        self.gain: Any = None
        self.forget()

    def forget(self) -> None:
        """Begin with another model; what was displayed stays."""
        self.diagnosis: Diagnosis | None = None
        self.ranking: tuple[RankedEffect, ...] = ()
        self.previews: dict[str, CandidatePreview] = {}
        self.verdict = ""

    def diagnosed(self, found: Diagnosis) -> None:
        """Keep what is missing from the model."""
        self.diagnosis, self.ranking, self.verdict = found, found.ranking, found.sentence
        self.previews = {p.effect: p for p in found.previews}

    def added(self, model: Model, before: float | None, found: Diagnosis | None) -> None:
        """Keep what one more effect has brought.

        Parameters
        ----------
        model : Model
            With the effect.
        before : float or None
            Excess without it.
        found : Diagnosis or None
            Where the model is complete.
        """
        if found is not None:
            self.diagnosed(found)
            return
        after = model.history[-1]
        gained = "" if before is None else f" from {before:.2g}"
        self.verdict = (
            f"{after['added']} is in the model: the excess is {after['excess']:.2g}{gained}. "
            "Diagnose says what is left."
        )

    def tried(self, ranking: Sequence[RankedEffect], previews: Sequence[CandidatePreview]) -> None:
        """Put effects of the user's own among the candidates."""
        own = {r.effect.name for r in ranking}
        rest = [r for r in self.ranking if r.effect.name not in own]
        self.ranking = tuple(sorted([*ranking, *rest], key=lambda r: r.held_out.excess))
        self.previews |= {p.effect: p for p in previews}
