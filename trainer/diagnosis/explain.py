"""Adding effects to a model: one that the user names, or one after the other until nothing more is worth adding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import CaptureRoles, capture_roles
from trainer.diagnosis.diagnose import Diagnosis, Progress, diagnose, ideal_errors
from trainer.diagnosis.screen import ScreenResult, screen_batches
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.definition import Effect
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import fit_from, least_for_order, raise_order, settled
from trainer.model.history import recorded
from trainer.model.model import EffectInstance, Model
from trainer.model.parameters import json_values

MOST_EFFECTS = 8  # an explanation longer than this explains nothing


@dataclass(frozen=True)
class Addition:
    """A model before and after an effect was added, judged on held-out captures."""

    effect: str
    model: Model
    before: PredictionErrors
    after: PredictionErrors

    def as_json(self) -> dict[str, Any]:
        """The contract's keys."""
        present = self.model.instance(self.effect)
        return {
            "before": self.before.as_json(),
            "after": self.after.as_json(),
            "parameters": json_values(present, self.model.bench),
        }


@dataclass(frozen=True)
class Step:
    """A rung of the ladder: what was added (or removed again), and the held-out errors then."""

    added: str | None
    held_out: PredictionErrors
    indistinguishable_from: tuple[str, ...] = ()
    removed: str | None = None

    def as_json(self) -> dict[str, Any]:
        """The contract's keys; `removed` only where an effect turned out not to be needed."""
        record: dict[str, Any] = {
            "added": self.added,
            "nrmse": self.held_out.nrmse,
            "excess": self.held_out.excess,
            "indistinguishable_from": list(self.indistinguishable_from),
        }
        if self.removed:
            record["removed"] = self.removed
        return record


@dataclass(frozen=True)
class Explanation:
    """The ladder from the first model to the last, and the verdict on what remains."""

    steps: tuple[Step, ...]
    model: Model
    diagnosis: Diagnosis
    diagnoses: tuple[Diagnosis, ...] = field(default=())

    def as_json(self, model_path: Path) -> dict[str, Any]:
        """The contract's keys."""
        return {
            "steps": [s.as_json() for s in self.steps],
            "verdict": self.diagnosis.verdict,
            "stage": self.diagnosis.stage,
            "noise_nrmse": self.diagnosis.held_out.noise_nrmse,
            "model": str(model_path),
            "sentence": self.diagnosis.sentence,
            "suggested_captures": [s for d in self.diagnoses for s in d.suggested_captures],
        }


def add(
    captures: CaptureSet,
    model: Model,
    effect: Effect,
    known: Catalogue | None = None,
    progress: Progress | None = None,
) -> Addition:
    """Add one effect to a model and refit all that is in it; an effect that is already there is refitted."""
    say = progress or (lambda done, what: None)
    parts = capture_roles(captures)
    model = with_gains(captures, model, parts.fitted)
    before = evaluate_captures(captures, parts.held_out, model)
    say(0.1, f"finding where {effect.name} starts")
    if effect.name in model.names:
        start = model.instance(effect.name)
    else:
        screened: list[ScreenResult] = screen_batches(load(captures, parts.screened), model, (effect,))
        start = screened[0].start
    say(0.3, f"fitting {effect.name}")
    added = add_from(parts, model, start)
    after = evaluate_captures(captures, parts.held_out, added)
    added = recorded(added, effect.name, after)
    say(1.0, "done")
    return Addition(effect.name, added, before, after)


def add_from(parts: CaptureRoles, model: Model, start: EffectInstance) -> Model:
    """The model with an effect fitted from a start, its order raised, and everything present refitted together."""
    batches = load(parts.captures, parts.fitted)
    name = start.effect.name
    fitted = fit_from(model, start, batches)
    fitted = raise_order(fitted, name, batches, least_for_order)
    return settled(fitted.model, batches).model if len(fitted.model.names) > 1 else fitted.model


def explain(
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds | None = None,
    save: Callable[[Model], None] | None = None,
    progress: Progress | None = None,
) -> Explanation:
    """Diagnose and add, again and again, until nothing more is worth adding.

    `save` is called with every model that is better than the one before. Effects that a later one makes needless are
    taken out again.
    """
    thresholds = thresholds or Thresholds()
    say = progress or (lambda done, what: None)
    parts = capture_roles(captures)
    model = with_gains(captures, model, parts.fitted)
    errors = evaluate_captures(captures, parts.held_out, model)
    ideal = ideal_errors(parts, model) if model.present else errors
    model = recorded(model, None, errors)
    if save:
        save(model)
    steps = [Step(None, errors)]
    diagnoses: list[Diagnosis] = []
    while True:
        done = len(steps) - 1

        def told(share: float, what: str, done: int = done) -> None:
            say(1 - 0.6**done * (1 - 0.4 * share), what)

        found = diagnose(captures, model, known, pool, thresholds, told, ideal, with_probes=False)
        diagnoses.append(found)
        best = found.best
        if best is None or len(model.names) >= MOST_EFFECTS:
            break
        told(0.9, f"adding {best.effect.name}")
        candidate = add_from(parts, best.base, best.model.instance(best.effect.name))
        after = evaluate_captures(captures, parts.held_out, candidate)
        if not thresholds.worth_adding(removed_excess(errors, after), ideal.excess, 1):
            break
        errors = after
        model = recorded(candidate, best.effect.name, errors)
        steps.append(Step(best.effect.name, errors, best.indistinguishable_from))
        if save:
            save(model)
        slimmer = _without_needless(parts, model, errors, best.effect.name, thresholds, ideal.excess)
        while slimmer is not None:
            dropped, model, errors = slimmer
            model = recorded(model, None, errors, dropped)
            steps.append(Step(None, errors, removed=dropped))
            if save:
                save(model)
            slimmer = _without_needless(parts, model, errors, best.effect.name, thresholds, ideal.excess)
    say(1.0, "done")
    return Explanation(tuple(steps), model, diagnoses[-1], tuple(diagnoses))


def _without_needless(
    parts: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    newest: str,
    thresholds: Thresholds,
    ideal_excess: float,
) -> tuple[str, Model, PredictionErrors] | None:
    """The model without an earlier effect that the newest has made needless, if there is one."""
    for name in model.names:
        if name == newest:
            continue
        rest = model.without(name)
        batches = load(parts.captures, parts.fitted)
        unexplained = not thresholds.complete(errors.excess, ideal_excess)
        fitted = (settled(rest, batches) if unexplained else fit(rest, rest.names, batches)).model
        without = evaluate_captures(parts.captures, parts.held_out, fitted)
        if not thresholds.worth_adding(removed_excess(without, errors), ideal_excess, 1):
            return name, fitted, without
    return None
