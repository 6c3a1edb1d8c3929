"""Which effects are screened on which captures.

Each colour and plane costs a screen as much as the first. So all effects are screened on the capture that the model
explains worst, and those that come near the best one there on a capture of each colour and plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from runtime.program.progress import Progress, no_progress, part_of
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture, ids_of
from trainer.captures.held_out import CaptureRoles, scenes
from trainer.diagnosis.screen import ScreenResult, screen, shares_of_work, starts_from_one
from trainer.diagnosis.telling import most_telling_capture, screened_captures
from trainer.effects.definition import Effect
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.pool import Pool
from trainer.model.model import Model

NEAR = (
    0.25  # of what the best effect is expected to remove: an effect of which so much is expected is near it
)
WHERE = " in each colour and plane"


def tells(effect: Effect, captures: CaptureSet) -> bool:
    """Whether captures can tell an effect from the one that it equals at one colour and plane."""
    return not effect.same_as or len(scenes(captures.captures)) > 1


def screen_candidates(
    roles: CaptureRoles, model: Model, known: Catalogue, pool: Pool, report: Progress
) -> list[ScreenResult]:
    """Screen the effects that a model lacks and that the captures can tell, shared out among the pool's workers.

    Parameters
    ----------
    report : callable
        Called with the share of the whole diagnosis that is done, and what is being done.

    Returns
    -------
    list of ScreenResult
        Those that come near the best one are whole.
    """
    candidates = [e for e in known.values() if e.name not in model.names and tells(e, roles.captures)]
    rows = screened_captures(roles, model)
    what = f"screening {len(candidates)} effects"
    if len(rows) < 2:
        return _screened(roles, rows, model, candidates, pool, part_of(report, 0.05, 0.3), what)
    telling = [most_telling_capture(roles.captures, rows, model)]
    found = _screened(roles, telling, model, candidates, pool, part_of(report, 0.05, 0.2), what)
    found = [replace(one, whole=False) for one in found]
    while near := _near_the_best(found):
        what = f"screening {len(near)} effects{WHERE}"
        whole = _screened(roles, rows, model, near, pool, part_of(report, 0.2, 0.3), what)
        found = _with_whole(found, whole)
    return found


def screened_whole(
    roles: CaptureRoles, model: Model, screened: Sequence[ScreenResult], pool: Pool
) -> list[ScreenResult]:
    """Candidates, each with the start that all colours and planes give it, in their order."""
    partial = [s.start.effect for s in screened if not s.whole and not starts_from_one(s.start.effect)]
    if not partial:
        return list(screened)
    rows = screened_captures(roles, model)
    return _with_whole(screened, _screened(roles, rows, model, partial, pool, no_progress, ""))


def _near_the_best(found: Sequence[ScreenResult]) -> list[Effect]:
    """Those that come near the best one, and are not whole."""
    most = max((s.removed_excess for s in found), default=0.0)
    return [s.start.effect for s in found if not s.whole and s.removed_excess >= NEAR * most]


def _with_whole(found: Sequence[ScreenResult], whole: Sequence[ScreenResult]) -> list[ScreenResult]:
    """Results with some of them whole; others are expected to remove the share that they do of one capture."""
    better, before = {s.effect: s for s in whole}, whole[0].before

    def scaled(one: ScreenResult) -> ScreenResult:
        share = one.removed_excess / one.before if one.before > 0 else 0.0
        return replace(one, before=before, after=before * (1 - share))

    return [better.get(s.effect, s if s.whole else scaled(s)) for s in found]


def _screened(
    roles: CaptureRoles,
    rows: Sequence[Capture],
    model: Model,
    effects: Sequence[Effect],
    pool: Pool,
    report: Progress,
    what: str,
) -> list[ScreenResult]:
    """Effects screened on these captures: one share of them for each worker, as each costs what is present."""
    shares = shares_of_work(effects, model, pool.workers)
    report(0.0, what)
    results = pool.map(
        screen,
        [(roles.folder, ids_of(rows), model, tuple(share)) for share in shares],
        lambda n: report(n / len(shares), what),
    )
    return [one for share in results for one in share]
