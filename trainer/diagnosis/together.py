"""Several strong effects that hide one another, explained together where no single one gets anywhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from runtime.excess import PredictionErrors
from runtime.program.progress import Progress, no_progress, part_of
from trainer.captures.batches import load
from trainer.captures.capture_set import chosen, opened
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles, with_patterns
from trainer.diagnosis.addition import maps_gone_on, with_orders_raised
from trainer.diagnosis.another_start import from_another_start
from trainer.diagnosis.screen import ScreenResult
from trainer.diagnosis.unnecessary import without_one
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.joint_start import TAKEN_FOR_EACH_OTHER, joint_start, without_effect
from trainer.fitting.least_squares_gain import with_gain
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import Predictor, evaluate_captures, excess_on, telling
from trainer.model.model import Model

FAR = 0.3  # held-out excess from which several strong effects may hide one another
# Share of the excess that one effect leaves at most if it gets anywhere alone; of EVEN, what a picture without any
# structure leaves, where that is less: an effect that only takes a wrong structure away gets nowhere.
HELPS, EVEN = 0.5, 1.0
# The same where the camera may lie elsewhere: a blur then removes much, of a wrong structure and not of what is wrong.
HELPS_ELSEWHERE = 0.1
# Excess from which other effects are missing: before these are there, to fit each one anew costs much and says little.
OTHERS = 0.1
# Of the excess while other effects are missing: an effect that removes less may only do a part of their work.
LITTLE = 0.05
# `tolerance` of the fit to all captures: what numbers take up slowly is for a map, which they would hide then.
LOOSE = 0.02
# One pattern alone, of a few bright spots or of rings, is predicted by wrong effects together as well as by the right.
PATTERNS = 3
MISSED_IN = 2  # captures of a colour and plane that say which effect is missed least
NEARLY = 0.002  # excess below which effects are where they belong: what is left is for the ladder to explain


@dataclass(frozen=True)
class JointExplanation:
    """Effects that were found together.

    Attributes
    ----------
    model : Model
        With all of them.
    ladder : tuple of (str, PredictionErrors)
        Effect by effect, held-out errors of the model with those so far: from the one that does most without the rest.
    """

    model: Model
    ladder: tuple[tuple[str, PredictionErrors], ...]


def is_far(roles: CaptureRoles, model: Model, errors: PredictionErrors) -> bool:
    """Whether so much is missing from a model without effects that several strong ones may hide one another."""
    return not model.present and errors.excess >= FAR and roles.is_held_out


def is_expected_somewhere(
    roles: CaptureRoles, screened: Sequence[ScreenResult], errors: PredictionErrors
) -> bool:
    """Whether the screen expects that one effect alone gets somewhere."""
    helps = HELPS if roles.captures.bench.camera.registered else HELPS_ELSEWHERE
    return not gets_nowhere(min((s.after for s in screened), default=math.inf), errors, helps)


def gets_nowhere(alone: float, errors: PredictionErrors, helps: float = HELPS) -> bool:
    """Whether an effect that leaves this much alone leaves more than a share of what is missing, or of even light's."""
    return alone >= helps * min(errors.excess, EVEN)


def explain_together(
    roles: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    known: Catalogue,
    thresholds: Thresholds,
    pool: Pool,
    progress: Progress | None = None,
) -> JointExplanation | None:
    """The effects that most benches have, fitted together from coarse to fine, less those that are not needed.

    Parameters
    ----------
    model : Model
        For which `is_far` holds, with fitted gains, and for which no effect alone gets anywhere.
    errors : PredictionErrors
        Of `model` on the held-out captures.

    Returns
    -------
    JointExplanation or None
        None where all together leave more than half of what is missing, or of what even light leaves.
    """
    report = progress or no_progress
    roles = with_patterns(roles, PATTERNS)
    batches = load(roles.captures, roles.fitted)
    least = thresholds.least(errors.excess)
    joint = joint_start(model, known, batches, least, part_of(report, 0.0, 0.6))
    joint = fit(joint, joint.names, batches, tolerance=LOOSE).model
    after = evaluate_captures(roles.captures, roles.held_out, joint)
    if gets_nowhere(after.excess, errors):
        return None

    def there() -> bool:
        return after.excess < NEARLY or thresholds.complete(after.excess, errors.excess)

    found, before_maps = joint, after
    if not there():
        report(0.6, "looking whether maps go on")
        joint, after = maps_gone_on(roles, joint, after, thresholds)
    alike = [name for name in TAKEN_FOR_EACH_OTHER if name in found.names]
    if len(alike) > 1 and not there():
        report(0.7, f"looking whether {' and '.join(alike)} are taken for each other")
        ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
        others = pool.map(_without, [(roles.folder, ids, held, found, name, known) for name in alike])
        still, left = min(others, key=lambda one: one[1].excess)
        if left.excess < before_maps.excess:
            joint, after = maps_gone_on(roles, still, left, thresholds)
    if after.excess < OTHERS and not there():
        report(0.75, "looking whether an effect ends better from another start")
        better = from_another_start(roles, joint, after, pool)
        if better is not None:
            _, joint, after = better
            joint, after = maps_gone_on(roles, joint, after, thresholds)
    report(0.8, "leaving out effects that are not needed")
    names = joint.names
    if after.excess >= OTHERS:
        thresholds = replace(thresholds, excess=max(thresholds.excess, LITTLE * after.excess))
    while smaller := without_one(roles, joint, after, names, thresholds, errors.excess, pool, thorough=False):
        dropped, joint, after = smaller
        names = names[names.index(dropped) + 1 :]
    if after.excess < OTHERS and not thresholds.complete(after.excess, errors.excess):
        report(0.9, "raising orders")  # so far, only a few of the captures have said how high they need be
        raised = with_orders_raised(roles, fit(joint, joint.names, batches, tolerance=LOOSE))
        left = evaluate_captures(roles.captures, roles.held_out, raised)
        if left.excess < after.excess:
            joint, after = raised, left
    return JointExplanation(joint, _ladder(roles, joint, after))


def _without(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, name: str, known: Catalogue
) -> tuple[Model, PredictionErrors]:
    """A joint model without one effect, the others fitted from smoothed pictures again, and its held-out errors."""
    captures = opened(folder)
    rest = without_effect(model, name, known, load(captures, chosen(captures, ids)))
    return rest, evaluate_captures(captures, chosen(captures, held_ids), rest)


@torch.no_grad()
def _ladder(
    roles: CaptureRoles, model: Model, errors: PredictionErrors
) -> tuple[tuple[str, PredictionErrors], ...]:
    """From the whole model down, each time without the effect that is missed least in a few of the captures."""
    few = [telling(model, b, MISSED_IN) for b in load(roles.captures, roles.fitted)]
    steps = []
    while model.names:
        rest = [model.without(name) for name in model.names]
        missed = [excess_on(with_gain(one, [Predictor(one, b) for b in few]), few) for one in rest]
        name = model.names[missed.index(min(missed))]
        steps.append((name, errors))
        model = with_gains(roles.captures, replace(model.without(name), gain={}), roles.fitted)
        errors = evaluate_captures(roles.captures, roles.held_out, model)
    return tuple(reversed(steps))
