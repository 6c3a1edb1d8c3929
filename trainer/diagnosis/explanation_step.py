"""One step of an explanation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from runtime.excess import PredictionErrors


@dataclass(frozen=True)
class ExplanationStep:
    """One step of an explanation.

    Attributes
    ----------
    added : str or None
        The effect that was added; None for the first model, and where one was only taken out.
    held_out : PredictionErrors
        Errors of the model after the step.
    indistinguishable_from : tuple of str
        Effects that the captures cannot tell the added one from.
    removed : str or None
        The effect that was taken out; with `added`, exchanged for that one.
    refined : str or None
        The effect of an earlier step whose map or curve went on in free form, whose colours were put together again, or
        that was fitted anew.
    form : mapping
        The key `form`, where it is a curve, the colours' values are in common again, or the start is another one.
    """

    added: str | None
    held_out: PredictionErrors
    indistinguishable_from: tuple[str, ...] = ()
    removed: str | None = None
    refined: str | None = None
    form: Mapping[str, str] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """A row of the key `steps` of `explain --json`.

        Keys `added`, `nrmse`, `excess` and `indistinguishable_from`; `removed` only where an effect was taken out,
        `refined` only where the map or curve of an earlier one went on in free form, its colours were put together, or
        it was fitted anew, and `form` where it is no map.
        """
        record: dict[str, Any] = {
            "added": self.added,
            "nrmse": self.held_out.nrmse,
            "excess": self.held_out.excess,
            "indistinguishable_from": list(self.indistinguishable_from),
        }
        if self.removed:
            record["removed"] = self.removed
        if self.refined:
            record["refined"] = self.refined
            record.update(self.form)
        return record
