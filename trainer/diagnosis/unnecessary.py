"""Effects that a model does as well without."""

from __future__ import annotations

from collections.abc import Sequence

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.batches import load
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.verdict import Thresholds
from trainer.fitting.gauss_newton import fit
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import settled
from trainer.model.model import Model

FEW_STEPS = 3


def without_one(
    roles: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    names: Sequence[str],
    thresholds: Thresholds,
    ideal_excess: float,
    thorough: bool = True,
) -> tuple[str, Model, PredictionErrors] | None:
    """The model without one of the named effects, if there is one that it does as well without.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.
    thorough : bool
        Refit the others to the end, and where something is unexplained raise their orders, to see whether they do its
        work. A few steps of the fit without it.

    Returns
    -------
    (str, Model, PredictionErrors) or None
        What was left out, and the model without it, refitted.
    """
    batches = load(roles.captures, roles.fitted)
    unexplained = not thresholds.complete(errors.excess, ideal_excess)
    for name in names:
        rest = model.without(name)
        if thorough and unexplained:
            fitted = settled(rest, batches).model
        else:
            fitted = fit(rest, rest.names, batches, iterations=12 if thorough else FEW_STEPS).model
        without = evaluate_captures(roles.captures, roles.held_out, fitted)
        if not thresholds.worth_adding(removed_excess(without, errors), ideal_excess, 1):
            return name, fitted, without
    return None
