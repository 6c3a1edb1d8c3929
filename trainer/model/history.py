"""The history of a model: one record a step, with the held-out errors after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from runtime.excess import PredictionErrors
from trainer.model.model import Model


def recorded(
    model: Model,
    name: str | None,
    errors: PredictionErrors,
    dropped: str | None = None,
    refined: str | None = None,
    form: Mapping[str, str] | None = None,
) -> Model:
    """The model with one more record in its history.

    Parameters
    ----------
    name : str or None
        The effect that was added; None for none.
    errors : PredictionErrors
        Held-out errors of the model.
    dropped : str, optional
        The effect that was taken out.
    refined : str, optional
        The effect whose map or curve went on in free form, whose colours were put together again, or that was fitted
        anew.
    form : mapping, optional
        The key `form` of such a record, where it is not that of `form_of`.
    """
    record: dict[str, Any] = {
        "added": name or "",
        **errors.as_json(),
        "date": datetime.now(UTC).date().isoformat(),
    }
    if dropped:
        record["removed"] = dropped
    if refined:
        record["refined"] = refined
        record.update(form_of(model, refined) if form is None else form)
    return replace(model, history=(*model.history, record))


IN_COMMON = {"form": "values in common"}  # of an effect whose colours were put together again
ANEW = {"form": "another start"}  # of an effect that was fitted anew, and all others after it


def form_of(model: Model, refined: str) -> dict[str, str]:
    """The key `form` of a record, where what went on is no map but a curve."""
    free = model.instance(refined).effect.free_form
    return {"form": free.form} if free is not None and free.curve else {}
