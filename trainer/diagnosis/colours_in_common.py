"""Effects whose colours came apart and do as well with values in common.

An effect may come apart for the work of another that is found later.
"""

from __future__ import annotations

from pathlib import Path

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.batches import load
from trainer.captures.capture_set import chosen, opened
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.verdict import Thresholds
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.colours_apart import put_together
from trainer.model.model import Model


def one_in_common(
    roles: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    thresholds: Thresholds,
    ideal_excess: float,
    pool: Pool,
) -> tuple[str, Model, PredictionErrors] | None:
    """The model with one effect's colours put together again, if there is one that does as well so.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.

    Returns
    -------
    (str, Model, PredictionErrors) or None
        The effect, and the model refitted with one value of it for all colours.
    """
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    names = [
        p.effect.name
        for p in model.present
        if p.effect.in_common is not None and p.effect.colours == "either"
    ]
    tasks = [(roles.folder, ids, held, model, name) for name in names]
    for name, (smaller, after) in zip(names, pool.map_here_if_one(fitted_in_common, tasks), strict=True):
        if not thresholds.worth_adding(removed_excess(after, errors), ideal_excess, 1):
            return name, smaller, after
    return None


def fitted_in_common(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, name: str
) -> tuple[Model, PredictionErrors]:
    """A model with one effect's colours put together, all fitted, and its errors on held-out captures.

    A task for any process.
    """
    captures = opened(folder)
    together = model.having(put_together(model.instance(name)))
    fitted = fit(together, together.names, load(captures, chosen(captures, ids))).model
    return fitted, evaluate_captures(captures, chosen(captures, held_ids), fitted)
