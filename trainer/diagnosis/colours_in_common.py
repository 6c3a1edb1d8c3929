"""Effects whose colours came apart and do as well with values in common.

An effect may come apart for the work of another that is found later.
"""

from __future__ import annotations

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.addition import all_refitted
from trainer.diagnosis.verdict import Thresholds
from trainer.fitting.pool import Pool
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
    names = [
        p.effect.name
        for p in model.present
        if p.effect.in_common is not None and p.effect.colours == "either"
    ]
    tasks = [(roles.folder, roles.ids, model.having(put_together(model.instance(name)))) for name in names]
    for name, (refitted, after) in zip(names, pool.map_here_if_one(all_refitted, tasks), strict=True):
        if not thresholds.worth_adding(removed_excess(after, errors), ideal_excess, 1):
            return name, refitted.model, after
    return None
