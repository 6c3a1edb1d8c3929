"""An effect of a model exchanged for one that the captures could not tell it from when it was added.

An effect that was added early may have stood for the right one: the two looked alike while others were missing.
"""

from __future__ import annotations

from collections.abc import Mapping

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.addition import with_everything_refitted
from trainer.fitting.pool import Pool
from trainer.model.model import EffectInstance, Model

Rivals = Mapping[
    str, Mapping[str, EffectInstance]
]  # by effect of the model, and by its rival: that one's fit


def exchanged(
    roles: CaptureRoles, model: Model, errors: PredictionErrors, rivals: Rivals, pool: Pool
) -> tuple[str, str, Model, PredictionErrors] | None:
    """The model with one effect exchanged for a rival, where held-out captures clearly say so.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.
    rivals : mapping
        A rival's fit is the one of when the effect was added, in its place.

    Returns
    -------
    (str, str, Model, PredictionErrors) or None
        What was taken out, what was put in its place, and the model, everything refitted.
    """
    pairs = [
        (old, new, fitted)
        for old, others in rivals.items()
        for new, fitted in others.items()
        if old in model.names and new not in model.names
    ]
    tasks = [(roles.folder, model.without(old), fitted) for old, _, fitted in pairs]
    found = list(zip(pairs, pool.map_here_if_one(with_everything_refitted, tasks), strict=True))
    if not found:
        return None
    (old, new, _), (other, after) = min(found, key=lambda one: one[1][1].excess)
    if removed_excess(errors, after).interval()[0] <= 0:
        return None
    return old, new, other, after
