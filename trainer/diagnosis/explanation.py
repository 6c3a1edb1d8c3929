"""An explanation of captures: effects added one after the other until nothing more is worth adding."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from runtime.excess import PredictionErrors, removed_excess
from runtime.program.progress import Progress, forward_only, no_progress, part_of
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import CaptureRoles, capture_roles
from trainer.diagnosis.addition import gone_on, with_maps_again
from trainer.diagnosis.another_start import from_another_start, nothing_expects_much
from trainer.diagnosis.chosen_addition import chosen_addition
from trainer.diagnosis.colours_in_common import one_in_common
from trainer.diagnosis.diagnosis import Diagnosis, diagnose, ideal_errors, screen_candidates
from trainer.diagnosis.exchange import CLEARLY, exchanged, one_for_two, preferred
from trainer.diagnosis.fitted_ranking import expects_the_rest
from trainer.diagnosis.learned_rest import LearnedRest, learn_rest
from trainer.diagnosis.screen import ScreenResult
from trainer.diagnosis.second_way import Fork, doubtful, fork_at, is_better, is_hopeless
from trainer.diagnosis.together import explain_together, is_far
from trainer.diagnosis.unnecessary import without_one
from trainer.diagnosis.verdict import Thresholds, below_the_noise
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.free_form_effects import can_go_on
from trainer.fitting.further_numbers import next_order
from trainer.fitting.gains import with_gains
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.history import ANEW, IN_COMMON, form_of, recorded
from trainer.model.model import EffectInstance, Model

MOST_EFFECTS = 8  # an explanation longer than this explains nothing


@dataclass(frozen=True)
class ExplanationStep:
    """One step of an explanation.

    Attributes
    ----------
    added : str or None
        The effect that was added; None for the first model, and where one was only taken out.
    held_out : PredictionErrors
        Errors of the model after the step.
    indistinguishable_from : tuple of str
        Effects that the captures cannot tell the added one from.
    removed : str or None
        The effect that was taken out; with `added`, exchanged for that one.
    refined : str or None
        The effect of an earlier step whose map or curve went on in free form, whose colours were put together again, or
        that was fitted anew.
    form : mapping
        The key `form`, where it is a curve, the colours' values are in common again, or the start is another one.
    """

    added: str | None
    held_out: PredictionErrors
    indistinguishable_from: tuple[str, ...] = ()
    removed: str | None = None
    refined: str | None = None
    form: Mapping[str, str] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """A row of the key `steps` of `explain --json`.

        Keys `added`, `nrmse`, `excess` and `indistinguishable_from`; `removed` only where an effect was taken out,
        `refined` only where the map or curve of an earlier one went on in free form, its colours were put together, or
        it was fitted anew, and `form` where it is no map.
        """
        record: dict[str, Any] = {
            "added": self.added,
            "nrmse": self.held_out.nrmse,
            "excess": self.held_out.excess,
            "indistinguishable_from": list(self.indistinguishable_from),
        }
        if self.removed:
            record["removed"] = self.removed
        if self.refined:
            record["refined"] = self.refined
            record.update(self.form)
        return record


@dataclass(frozen=True)
class Explanation:
    """The steps from the first model to the last, and the verdict on what remains.

    Attributes
    ----------
    diagnosis : Diagnosis
        Of the last model.
    diagnoses : tuple of Diagnosis
        One before each step, the last included.
    learned : LearnedRest or None
        What was learned after the last step, where that was asked for and something was left.
    """

    steps: tuple[ExplanationStep, ...]
    model: Model
    diagnosis: Diagnosis
    diagnoses: tuple[Diagnosis, ...] = field(default=())
    learned: LearnedRest | None = None

    def as_json(self, model_path: Path) -> dict[str, Any]:
        """The object that `explain --json` prints.

        Keys `steps`, `verdict`, `stage`, `noise_nrmse`, `model`, `sentence`, `held_out` (false where the captures
        hold one pattern), `suggested_captures`, `equal_facts`, `table_facts`, `camera_facts`, and `learned` where that
        was asked for.
        """
        return {
            "steps": [s.as_json() for s in self.steps],
            "verdict": self.diagnosis.verdict,
            "stage": self.diagnosis.stage,
            "noise_nrmse": self.diagnosis.held_out.noise_nrmse,
            "model": str(model_path),
            "sentence": self.diagnosis.sentence,
            "held_out": self.diagnosis.is_held_out,
            "suggested_captures": list(
                dict.fromkeys(s for d in self.diagnoses for s in d.suggested_captures)
            ),
            "equal_facts": [f.as_json() for f in self.diagnosis.equal_facts.facts],
            "table_facts": [f.as_json() for f in self.diagnosis.table_facts],
            "camera_facts": [f.as_json() for f in self.diagnosis.camera_facts],
            **({} if self.learned is None else {"learned": self.learned.as_json()}),
        }


def explain(
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds | None = None,
    save: Callable[[Model], None] | None = None,
    progress: Progress | None = None,
    learn: bool = False,
) -> Explanation:
    """Diagnose and add, again and again, until nothing more is worth adding.

    Effects that a later one makes unnecessary are taken out again. Where nothing more is missing, but enough is left
    for another explanation to be worth it, a second way is tried: without an effect that a rival came near to.

    Parameters
    ----------
    save : callable, optional
        Called with every model that is better than the one before.
    progress : callable, optional
        Called with the share that is done and what is being done.
    learn : bool
        Learn what nothing named explains, at the stages that the probes name.
    """
    report = forward_only(progress or no_progress)
    found, forks, ideal = _one_way(captures, model, known, pool, thresholds, save, report)
    diagnosis = found.diagnosis
    fork = doubtful(forks, found.model) if _leaves_much(diagnosis, ideal) else None
    if fork is not None:
        others = {name: effect for name, effect in known.items() if name != fork.added}
        again = part_of(report, 0.95, 1.0, f"without {fork.added}")
        end = (found.model, found.steps[-1].held_out)
        other, *_ = _one_way(captures, fork.before, others, pool, thresholds, None, again, to_beat=end)
        level = diagnosis.thresholds.level
        if is_better(*end, other.model, other.steps[-1].held_out, 1 - level):
            steps = (*found.steps[: fork.step], *other.steps[1:])
            diagnoses = (*found.diagnoses[: fork.diagnosis], *other.diagnoses)
            found = Explanation(steps, other.model, other.diagnosis, diagnoses)
            if save:
                save(found.model)
    if learn and found.diagnosis.verdict != "complete" and not below_the_noise(found.steps[-1].held_out):
        roles = capture_roles(captures)
        rest = learn_rest(roles, found.model, found.diagnosis, pool, part_of(report, 0.8, 1.0))
        found = replace(found, model=rest.model, learned=rest)
    report(1.0, "")
    return found


def _leaves_much(found: Diagnosis, ideal: PredictionErrors) -> bool:
    """Whether nothing is missing, and yet enough is left for an effect to be worth it."""
    enough = found.thresholds.may_be_worth_adding(found.held_out.excess, ideal.excess)
    return found.verdict == "complete" and enough


def _one_way(
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds | None,
    save: Callable[[Model], None] | None,
    report: Progress,
    to_beat: tuple[Model, PredictionErrors] | None = None,
) -> tuple[Explanation, list[Fork], PredictionErrors]:
    """An explanation by the best candidate at each step, where others came near, and the ideal model's errors.

    Parameters
    ----------
    to_beat : (Model, PredictionErrors), optional
        Where another way ended. This one goes on from a model with its history, and ends early where it is hopeless.
    """
    thresholds = thresholds or Thresholds()
    roles = capture_roles(captures)
    model = with_gains(captures, model, roles.fitted)
    errors = evaluate_captures(captures, roles.held_out, model)
    ideal = ideal_errors(roles, model) if model.present else errors
    steps: list[ExplanationStep] = []
    # By each effect that was added, those that could have been added in its place.
    rivals: dict[str, dict[str, EffectInstance]] = {}
    diagnoses: list[Diagnosis] = []
    forks: list[Fork] = []
    # The last model that was asked which of its maps or curves goes on, and the answer.
    asked: tuple[Model, tuple[str, Model, PredictionErrors] | None] | None = None

    def took(model: Model, *new: ExplanationStep) -> None:
        """Note the steps that led to a model, and save it."""
        steps.extend(new)
        if save:
            save(model)

    if to_beat is None:
        model = recorded(model, None, errors)
    took(model, ExplanationStep(None, errors))

    def limits() -> Thresholds:
        """As the last diagnosis has them, with the floor of the noise."""
        return diagnoses[-1].thresholds if diagnoses else thresholds

    def without_unnecessary(
        model: Model, errors: PredictionErrors, names: Sequence[str]
    ) -> tuple[Model, PredictionErrors]:
        """The model without those of the named effects that it does as well without, each a step."""
        while True:
            smaller = without_one(roles, model, errors, names, limits(), ideal.excess, pool)
            if smaller is None:
                return model, errors
            dropped, model, errors = smaller
            names = [n for n in names if n != dropped]
            model = recorded(model, None, errors, dropped)
            took(model, ExplanationStep(None, errors, removed=dropped))

    def in_free_form(
        model: Model, errors: PredictionErrors, report: Progress
    ) -> tuple[str, Model, PredictionErrors] | None:
        """The effect whose map or curve goes on in free form, and the model with it; it is asked once of a model."""
        nonlocal asked
        if asked is None or asked[0] is not model:
            report(1.0, "looking whether maps and curves go on")
            asked = model, _any_gone_on(roles, model, errors, limits())
        return asked[1]

    def took_on(name: str, model: Model, errors: PredictionErrors) -> tuple[Model, PredictionErrors]:
        """Note that a map or curve went on."""
        model = recorded(model, None, errors, refined=name)
        took(model, ExplanationStep(None, errors, refined=name, form=form_of(model, name)))
        return model, errors

    def looked_at_again(
        model: Model, errors: PredictionErrors, report: Progress
    ) -> tuple[Model, PredictionErrors, list[ScreenResult] | None]:
        """The model with effects exchanged for rivals, fitted anew or gone on, and the screen of what it lacks then.

        While one more effect is expected to explain the rest, there is no reason to doubt those that are present.
        """
        while not limits().complete(errors.excess, ideal.excess):
            screened = screen_candidates(roles, model, known, pool, report)
            if expects_the_rest(screened):
                return model, errors, screened
            report(1.0, "looking whether another effect should stand in the place of one")
            better = exchanged(roles, model, errors, rivals, pool)
            if better is not None:
                old, new, model, errors = better
                del rivals[old]
                model = recorded(model, new, errors, old)
                took(model, ExplanationStep(new, errors, removed=old))
                continue
            if not nothing_expects_much(screened):
                return model, errors, screened
            report(1.0, "looking whether an effect ends better from another start")
            anew = from_another_start(roles, model, errors, pool)
            if anew is not None and anew[2].excess < CLEARLY * errors.excess:
                name, model, errors = anew
                model = recorded(model, None, errors, refined=name, form=ANEW)
                took(model, ExplanationStep(None, errors, refined=name, form=ANEW))
                continue
            further = in_free_form(model, errors, report)
            if further is None or further[2].excess > CLEARLY * errors.excess:
                return model, errors, screened
            model, errors = took_on(*further)
        return model, errors, None

    screened = together = None
    if is_far(roles, model, errors):
        screened = screen_candidates(roles, model, known, pool, report)
        together = explain_together(
            roles, model, errors, known, screened, thresholds, pool, part_of(report, 0.3, 0.4)
        )
    if together is not None:
        screened = None  # of another model
        history = model
        for name, errors in together.ladder:
            history = recorded(history, name, errors)
        model = replace(together.model, history=history.history)
        took(model, *(ExplanationStep(*rung) for rung in together.ladder))

    while True:
        done = len(steps) - 1
        report_share = part_of(report, 1 - 0.6**done, 1 - 0.6**done * 0.6)
        diagnosing = part_of(report_share, 0, 0.9)
        if model.present:
            model, errors, screened = looked_at_again(model, errors, diagnosing)
        found = diagnose(captures, model, known, pool, thresholds, diagnosing, ideal, False, screened)
        screened = None
        diagnoses.append(found)
        best = found.best
        if best is None or len(model.names) >= MOST_EFFECTS:
            outside = found.verdict == "outside_catalogue" and not below_the_noise(errors)
            further = in_free_form(model, errors, part_of(report_share, 0.8, 0.9)) if outside else None
            if further is None:
                break
            model, errors = took_on(*further)
            continue
        report_share(0.9, f"adding {best.effect.name}")
        best, candidate, after = chosen_addition(roles, found, pool)
        candidate, after = with_maps_again(roles, candidate, after)
        # A map whose next order did not help is looked at again only where nothing else fits.
        if next_order(candidate.instance(best.effect.name)) is None:
            mapped = gone_on(roles, candidate, best.effect.name, after, found.thresholds)
            candidate, after = mapped or (candidate, after)
        if not found.thresholds.worth_adding(removed_excess(errors, after), ideal.excess, 1):
            break
        forks.append(fork_at(len(steps), len(diagnoses) - 1, model, best, found.ranking))
        errors = after
        model = recorded(candidate, best.effect.name, errors)
        took(model, ExplanationStep(best.effect.name, errors, best.indistinguishable_from))
        newest = best.effect.name
        report_share(0.95, "looking which effects are needed no longer")
        model, errors = without_unnecessary(model, errors, [n for n in model.names if n != newest])
        if to_beat is not None and is_hopeless(model, errors, *to_beat):
            return Explanation(tuple(steps), model, found, tuple(diagnoses)), forks, ideal
        rivals[newest] = {
            r.effect.name: r.model.instance(r.effect.name)
            for r in found.ranking
            if r.worth_adding and r.effect.name != newest
        }
    kept = model.names
    last = part_of(report, 1 - 0.6 ** (len(steps) - 1), 1.0)
    last(0.8, "comparing effects with what could stand in their place")
    alike = {
        s.added: {n: one for n, one in rivals[s.added].items() if n in s.indistinguishable_from}
        for s in steps
        if s.added in rivals
    }
    if _leaves_much(diagnoses[-1], ideal):
        alike = dict(rivals)  # enough is left for another in place of one to be worth it
    while (better := preferred(roles, model, errors, alike, limits(), ideal.excess, pool)) is not None:
        old, new, model, errors = better
        del alike[old]
        model = recorded(model, new, errors, old)
        took(model, ExplanationStep(new, errors, removed=old))
    simpler = one_for_two(roles, model, errors, rivals, limits(), ideal.excess, pool)
    if simpler is not None:
        new, old, other, model, errors = simpler
        model = recorded(recorded(model, new, errors, old), None, errors, other)
        took(model, ExplanationStep(new, errors, removed=old), ExplanationStep(None, errors, removed=other))
    # A last pass: of every effect but the newest it is known already that the rest cannot do without it.
    if len(model.names) > 1:
        last(0.9, "looking which effects are needed no longer")
        model, errors = without_unnecessary(model, errors, [steps[-1].added] if steps[-1].added else [])
    while (common := one_in_common(roles, model, errors, limits(), ideal.excess, pool)) is not None:
        name, model, errors = common
        model = recorded(model, None, errors, refined=name, form=IN_COMMON)
        took(model, ExplanationStep(None, errors, refined=name, form=IN_COMMON))
    if model.names != kept or steps[-1].form == IN_COMMON:
        found = diagnose(captures, model, known, pool, thresholds, None, ideal, thorough=False)
        diagnoses.append(found)
    return Explanation(tuple(steps), model, diagnoses[-1], tuple(diagnoses)), forks, ideal


def _any_gone_on(
    roles: CaptureRoles, model: Model, errors: PredictionErrors, thresholds: Thresholds
) -> tuple[str, Model, PredictionErrors] | None:
    """The effect whose map or curve, gone on in free form, leaves least, if there is one that is worth it."""
    found = []
    for name in can_go_on(model):
        further = gone_on(roles, model, name, errors, thresholds)
        if further is not None:
            found.append((name, *further))
    return min(found, key=lambda one: one[2].excess, default=None)
