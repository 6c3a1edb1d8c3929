"""Effects that end better from another start, once others are there.

What an effect took up while the others were missing, or far from right, may keep all of them from where they belong:
the leak of a panel that is bent, say, what the panel's wavefront still lacked, or crosstalk a camera's motion.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.candidate_fits import try_again, try_without
from trainer.diagnosis.screen import ScreenResult
from trainer.diagnosis.telling import telling_captures
from trainer.diagnosis.verdict import Thresholds
from trainer.fitting.pool import Pool
from trainer.model.model import Model

EXPECTED = 0.25  # share of the excess


def nothing_expects_much(screened: Sequence[ScreenResult]) -> bool:
    """Whether no effect that a model lacks is expected to remove much of what is left, with the present ones free."""
    return all(s.removed_excess < EXPECTED * s.before for s in screened)


def from_another_start(
    roles: CaptureRoles, model: Model, errors: PredictionErrors, pool: Pool
) -> tuple[str, Model, PredictionErrors] | None:
    """The model with that effect fitted anew which then leaves least, all others after it.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.

    Returns
    -------
    (str, Model, PredictionErrors) or None
        The effect, the model, and its errors; None where no other start helps. Effects with maps in free form are left
        as they are.
    """
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    names = [p.effect.name for p in model.present if p.nodes is None]
    found = pool.map(try_again, [(roles.folder, ids, held, model, name) for name in names])
    best = min((f for f in found if f is not None), key=lambda f: f.held_out.excess, default=None)
    if best is None or removed_excess(errors, best.held_out).interval()[0] <= 0:
        return None
    return best.effect, best.model, best.held_out


def fewer_from_another_start(
    roles: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    thresholds: Thresholds,
    ideal_excess: float,
    pool: Pool,
) -> tuple[str, Model, PredictionErrors] | None:
    """The model without one effect, the others all fitted anew, if there is one that it then does as well without.

    Where an effect ended in a wrong place, another one of its stage may have been added for what it lacks there.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.

    Returns
    -------
    (str, Model, PredictionErrors) or None
        The effect that goes, the model, and its errors.
    """
    several = Counter(p.effect.stage for p in model.present)
    names = [p.effect.name for p in model.present if several[p.effect.stage] > 1]
    if not names:
        return None
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    few = ids_of(telling_captures(roles.captures, roles.fitted, model))
    least = thresholds.least(ideal_excess)
    found = pool.map_here_if_one(
        try_without, [(roles.folder, few, ids, held, model, name, least) for name in names]
    )
    best = min((f for f in found if f is not None), key=lambda f: f.held_out.excess, default=None)
    if best is None or thresholds.worth_adding(removed_excess(best.held_out, errors), ideal_excess, 1):
        return None
    return best.effect, best.model, best.held_out
