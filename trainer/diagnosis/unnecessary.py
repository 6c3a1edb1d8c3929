"""Effects that a model does as well without."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.batches import load
from trainer.captures.capture_set import chosen, opened
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.verdict import Thresholds
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import Pool
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
    pool: Pool,
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
    ids, held = (tuple(c.capture for c in rows) for rows in (roles.fitted, roles.held_out))
    raising = thorough and not thresholds.complete(errors.excess, ideal_excess)
    for first in range(0, len(names), pool.workers):  # as many at a time as there are processes
        some = names[first : first + pool.workers]
        tasks = [
            (roles.folder, ids, held, model.without(name), raising, 12 if thorough else FEW_STEPS)
            for name in some
        ]
        for name, (fitted, without) in zip(some, pool.map_here_if_one(refitted, tasks), strict=True):
            if not thresholds.worth_adding(removed_excess(without, errors), ideal_excess, 1):
                return name, fitted, without
    return None


def refitted(
    folder: Path,
    ids: tuple[str, ...],
    held_ids: tuple[str, ...],
    model: Model,
    raising: bool,
    iterations: int,
) -> tuple[Model, PredictionErrors]:
    """A model with all of its effects fitted together, and its errors on held-out captures: a task for any process.

    Parameters
    ----------
    folder : Path
        Of the capture set.
    ids, held_ids : tuple of str
        Captures to fit, and captures to judge by.
    raising : bool
        Raise orders as far as that helps.
    iterations : int
        Of the fit, where orders are not raised.
    """
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    fitted = settled(model, batches) if raising else fit(model, model.names, batches, iterations)
    return fitted.model, evaluate_captures(captures, chosen(captures, held_ids), fitted.model)
