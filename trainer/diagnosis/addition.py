"""Adding one effect to a model: fitted from a start, its order raised, gone on in free form where that pays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from runtime.excess import PredictionErrors, removed_excess
from runtime.program.progress import Progress, no_progress
from trainer.captures.batches import Batch, load
from trainer.captures.capture_set import CaptureSet, chosen, opened
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import FIT_CAPTURES, CaptureRoles, capture_roles, scenes, with_stopping
from trainer.diagnosis.screen import ScreenResult, screen_batches
from trainer.diagnosis.telling import screened_captures
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.definition import Effect
from trainer.fitting.free_form_effects import (
    begun_in_free_form,
    free_maps,
    polynomial_maps,
    refined,
    settled,
    with_free_form,
)
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import FitResult, fit
from trainer.fitting.pixel_values import with_pixel_values
from trainer.fitting.predictor import evaluate_captures, excess_on
from trainer.fitting.refit import fit_from, least_for_order, raise_orders
from trainer.model.history import recorded
from trainer.model.model import EffectInstance, Model
from trainer.model.parameters import json_values


@dataclass(frozen=True)
class Addition:
    """An effect that was added to a model.

    Attributes
    ----------
    effect : str
        Name of the effect.
    model : Model
        With the effect, and everything refitted.
    before, after : PredictionErrors
        On the held-out captures, without and with the effect.
    is_held_out : bool
        False where there is only one pattern, so that what is judged is what was fitted.
    """

    effect: str
    model: Model
    before: PredictionErrors
    after: PredictionErrors
    is_held_out: bool = True

    def as_json(self) -> dict[str, Any]:
        """The object that `add --json` prints: keys `before`, `after`, `parameters` and `held_out`."""
        present = self.model.instance(self.effect)
        return {
            "before": self.before.as_json(),
            "after": self.after.as_json(),
            "parameters": json_values(present, self.model.bench),
            "held_out": self.is_held_out,
        }


def add(
    captures: CaptureSet,
    model: Model,
    effect: Effect,
    progress: Progress | None = None,
) -> Addition:
    """Add one effect to a model and refit all of its effects; an effect that is already there is refitted.

    Parameters
    ----------
    progress : callable, optional
        Called with the share that is done and what is being done.
    """
    report = progress or no_progress
    roles = capture_roles(captures)
    model = with_gains(captures, model, roles.fitted)
    before = evaluate_captures(captures, roles.held_out, model)
    report(0.1, f"finding where {effect.name} starts")
    if effect.name in model.names:
        start = model.instance(effect.name)
    else:
        batches = load(captures, screened_captures(roles, model))
        screened: list[ScreenResult] = screen_batches(batches, model, (effect,))
        start = screened[0].start
    report(0.3, f"fitting {effect.name}")
    added = add_from(roles, model, start)
    after = evaluate_captures(captures, roles.held_out, added)
    report(0.7, f"looking whether {effect.name} goes on in free form")
    limits = Thresholds()
    added, after = gone_on(roles, added, effect.name, after, limits) or (added, after)
    added = recorded(added, effect.name, after)
    report(1.0, "")
    return Addition(effect.name, added, before, after, roles.is_held_out)


def add_from(roles: CaptureRoles, model: Model, start: EffectInstance) -> Model:
    """The model with an effect fitted from a start, everything present refitted together, and orders raised."""
    batches = load(roles.captures, roles.fitted)
    fitted = fit_from(model, start, batches)
    if len(fitted.model.names) > 1:
        fitted = fit(fitted.model, fitted.model.names, batches)
    return with_orders_raised(roles, fitted)


def all_refitted(folder: Path, ids: tuple[str, ...], *starts: Model) -> tuple[FitResult, PredictionErrors]:
    """A model with all of its effects fitted together, and its held-out errors.

    A task for any process.

    Parameters
    ----------
    starts : Model
        Where the fit may begin: it does from the one that leaves least.
    """
    roles = _roles_of(folder, ids)
    batches = load(roles.captures, roles.fitted)
    model = min(starts, key=lambda one: excess_on(one, batches)) if len(starts) > 1 else starts[0]
    found = fit(model, model.names, batches)
    return found, evaluate_captures(roles.captures, roles.held_out, found.model)


def _roles_of(folder: Path, ids: tuple[str, ...]) -> CaptureRoles:
    """The roles of these captures of a set, in any process."""
    captures = opened(folder)
    return capture_roles(replace(captures, captures=tuple(chosen(captures, ids))))


def all_raised(
    folder: Path, ids: tuple[str, ...], fitted: FitResult, errors: PredictionErrors
) -> tuple[Model, PredictionErrors]:
    """A fitted model with its effects' orders raised as far as that helps, and its held-out errors.

    A task for any process.

    Parameters
    ----------
    errors : PredictionErrors
        Of the model as it is on the held-out captures.
    """
    roles = _roles_of(folder, ids)
    model = with_orders_raised(roles, fitted)
    if model is not fitted.model:
        errors = evaluate_captures(roles.captures, roles.held_out, model)
    return model, errors


def with_orders_raised(roles: CaptureRoles, fitted: FitResult) -> Model:
    """A fitted model with its effects' orders raised as far as that helps, and numbers by pixel from all captures."""
    batches = load(roles.captures, roles.fitted)
    model = raise_orders(fitted, fitted.model.names, batches, least_for_order).model
    return with_pixel_values(roles.captures, model)


def gone_on(
    roles: CaptureRoles, model: Model, name: str, errors: PredictionErrors, thresholds: Thresholds
) -> tuple[Model, PredictionErrors] | None:
    """The model with an effect's map or curve gone on in free form, and its held-out errors, where these say so.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.

    Returns
    -------
    (Model, PredictionErrors) or None
        None where the effect has no free form, or where nothing is left that one is worth.
    """
    present = model.instance(name)
    if present.effect.free_form is None or present.nodes is not None or not roles.is_held_out:
        return None
    if thresholds.complete(errors.excess, errors.excess):
        return None
    # A finer map costs much, and says nothing where no more is left than is worth adding; a finer curve costs little.
    enough = 0.0 if present.effect.free_form.curve else thresholds.excess
    further = with_free_form(model, name, *_for_maps(roles, model), enough)
    if further is None:
        return None
    after = evaluate_captures(roles.captures, roles.held_out, further)
    worth = thresholds.worth_adding(removed_excess(errors, after), errors.excess, 1)
    return (further, after) if worth else None


def maps_gone_on(
    roles: CaptureRoles, model: Model, errors: PredictionErrors, thresholds: Thresholds
) -> tuple[Model, PredictionErrors]:
    """The model with those of its maps gone on in free form that pay, and its held-out errors.

    All begin before any goes finer: what one hides, the next may show.
    """
    while roles.is_held_out and not thresholds.complete(errors.excess, errors.excess):
        first, last = _for_maps(roles, model)
        begun, tried = model, list[str]()
        while names := [n for n in polynomial_maps(begun) if n not in tried]:
            found = begun_in_free_form(begun, names[0], first, last)
            begun, tried = (begun, [*tried, names[0]]) if found is None else (found, [])
        if begun is model:
            break
        further = settled(begun, free_maps(begun), first, last, thresholds.excess)
        after = evaluate_captures(roles.captures, roles.held_out, further)
        if not thresholds.worth_adding(removed_excess(errors, after), errors.excess, 1):
            break
        model, errors = further, after
    return model, errors


def _for_maps(roles: CaptureRoles, model: Model) -> tuple[list[Batch], list[Batch]]:
    """Captures that maps are fitted to, and those that say when to stop."""
    first, last = with_stopping(_worst_first(roles, model), FIT_CAPTURES)
    return load(roles.captures, first), load(roles.captures, last)


def _worst_first(roles: CaptureRoles, model: Model) -> list[Capture]:
    """The probed captures, worst predicted ones first; the second worst of each colour and plane stands at the end.

    A spot or a grating may say nothing of a map: what a map is fitted to, and what says when to stop, must.
    """
    ordered = []
    for scene in scenes(roles.probed):
        rows = [c for c in roles.probed if (c.channel, c.plane_mm) == scene]
        excess = {c.capture: evaluate_captures(roles.captures, [c], model).excess for c in rows}
        rows.sort(key=lambda c: -excess[c.capture])
        ordered += rows[:1] + rows[2:] + rows[1:2]
    return ordered


def with_maps_again(
    roles: CaptureRoles, model: Model, errors: PredictionErrors
) -> tuple[Model, PredictionErrors]:
    """The model with the maps that it has fitted again, next to a new effect: they give back what was not theirs."""
    if all(p.nodes is None for p in model.present):
        return model, errors
    again = refined(model, *_for_maps(roles, model))
    after = evaluate_captures(roles.captures, roles.held_out, again)
    return (again, after) if after.excess < errors.excess else (model, errors)
