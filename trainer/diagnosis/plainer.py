"""Plainer effects that could stand in the place of an effect, with everything else there.

An effect of several numbers can do what one of fewer does: two spectral lines at nearly one place are another distance.
While other effects are missing, it may fit a little better than the plainer one, which is then not a rival of it.
"""

from __future__ import annotations

from collections.abc import Sequence

from runtime.program.progress import no_progress
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.screening import screen_candidates, screened_whole
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.pool import Pool
from trainer.model.model import EffectInstance, Model, absent

# Of what is left without an effect: where the screen expects a plainer one to leave no more, a fit may find that it
# does as well. The screen sees a straight line's step alone.
EXPECTED = 0.25
TRIED = 2  # plainer effects in the place of one


def plainer_rivals(
    roles: CaptureRoles, model: Model, names: Sequence[str], known: Catalogue, pool: Pool
) -> dict[str, dict[str, EffectInstance]]:
    """By named effects of a model, plainer ones that it lacks and that may do as well in the place: where these start.

    Parameters
    ----------
    names : sequence of str
        Effects of the model, each of which is taken out in turn.
    known : mapping of str to Effect
        Effects to look among.
    """
    found: dict[str, dict[str, EffectInstance]] = {}
    for name in names:
        plainer = {
            n: effect
            for n, effect in known.items()
            if n not in model.names and absent(effect, model.bench).is_plainer_than(model.instance(name))
        }
        if not plainer:
            continue
        rest = with_gains(roles.captures, model.without(name), roles.fitted)
        screened = screen_candidates(roles, rest, plainer, pool, no_progress)
        likely = sorted((s for s in screened if s.after <= EXPECTED * s.before), key=lambda s: s.after)
        found[name] = {s.effect: s.start for s in screened_whole(roles, rest, likely[:TRIED], pool)}
    return found
