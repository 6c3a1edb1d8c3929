"""One way to an explanation: an effect added at a time, and what is there looked at again after each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from runtime.excess import PredictionErrors, removed_excess
from runtime.program.progress import Progress, part_of
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import CaptureRoles, capture_roles
from trainer.diagnosis.addition import gone_on, with_maps_again
from trainer.diagnosis.another_start import (
    fewer_from_another_start,
    from_another_start,
    nothing_expects_much,
)
from trainer.diagnosis.chosen_addition import chosen_addition
from trainer.diagnosis.colours_in_common import one_in_common
from trainer.diagnosis.diagnosis import Diagnosis, diagnose, ideal_errors, screen_candidates
from trainer.diagnosis.exchange import CLEARLY, exchanged, one_for_two, preferred
from trainer.diagnosis.explanation_step import ExplanationStep
from trainer.diagnosis.fitted_ranking import expects_the_rest
from trainer.diagnosis.plainer import plainer_rivals
from trainer.diagnosis.ranking import RankedEffect
from trainer.diagnosis.screen import ScreenResult
from trainer.diagnosis.second_way import Fork, fork_at, is_hopeless
from trainer.diagnosis.together import explain_together, gets_nowhere, is_expected_somewhere, is_far
from trainer.diagnosis.unnecessary import without_one
from trainer.diagnosis.verdict import Thresholds, below_the_noise
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.free_form_effects import can_go_on
from trainer.fitting.further_numbers import next_order
from trainer.fitting.gains import with_gains
from trainer.fitting.pixel_values import pixel_noise
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.history import ANEW, IN_COMMON, form_of, recorded
from trainer.model.model import EffectInstance, Model

# An explanation longer than this explains nothing: one more must remove so much of what is left. So it can complete one
# that began with many effects together, of which some may then not be needed.
MOST_EFFECTS, MUCH = 8, 0.5
# Of what there was: where an effect left more when it was added, others were missing that could make it look right.
UNSURE = 0.25


class Way:
    """An explanation under way: the model so far, the steps that led to it, and what could have been in their place.

    Parameters
    ----------
    captures : CaptureSet
    model : Model
        Where it begins.
    known : mapping of str to Effect
        Effects to try.
    pool : Pool
    thresholds : Thresholds, optional
    save : callable, optional
        Called with every model that is better than the one before.
    end_to_beat : (Model, PredictionErrors), optional
        Where another way ended. This one goes on from a model with its history, and ends early where it is hopeless.

    Attributes
    ----------
    model : Model
    errors : PredictionErrors
        Of the model on the held-out captures.
    ideal : PredictionErrors
        Of the bench file's own model.
    steps : list of ExplanationStep
    diagnoses : list of Diagnosis
        One before each addition, and of the last model.
    forks : list of Fork
        One for each addition.
    """

    def __init__(
        self,
        captures: CaptureSet,
        model: Model,
        known: Catalogue,
        pool: Pool,
        thresholds: Thresholds | None = None,
        save: Callable[[Model], None] | None = None,
        end_to_beat: tuple[Model, PredictionErrors] | None = None,
    ) -> None:
        self._captures, self._known, self._pool, self._save = captures, known, pool, save
        self._end_to_beat = end_to_beat
        self._thresholds = thresholds or Thresholds()
        self._roles = capture_roles(captures)
        self.model = with_gains(captures, model, self._roles.fitted)
        self.errors = evaluate_captures(captures, self._roles.held_out, self.model)
        self.ideal = ideal_errors(self._roles, self.model) if self.model.present else self.errors
        self.steps: list[ExplanationStep] = []
        self.diagnoses: list[Diagnosis] = []
        self.forks: list[Fork] = []
        # By each effect that was added, those that could have been added in its place.
        self._rivals: dict[str, dict[str, EffectInstance]] = {}
        # The last model that was asked which of its maps or curves goes on, and the answer.
        self._asked: tuple[Model, tuple[str, Model, PredictionErrors] | None] | None = None
        self._noise: tuple[Model, float] | None = None  # of a model's values by pixel
        if end_to_beat is None:
            self.model = recorded(self.model, None, self.errors)
        self._took(ExplanationStep(None, self.errors))

    def go(self, progress: Progress) -> None:
        """Add effects until nothing more is worth adding, and look whether others should stand in their place.

        Parameters
        ----------
        progress : callable
            Called with the share that is done and what is being done.
        """
        first = self._first_look(progress) if is_far(self._roles, self.model, self.errors) else None
        while True:
            done = len(self.steps) - 1
            report = part_of(progress, 1 - 0.6**done, 1 - 0.6**done * 0.6)
            diagnosing = part_of(report, 0, 0.9)
            screened = self._look_again(diagnosing) if self.model.present else None
            found = first or self._diagnosed(diagnosing, screened)
            first = None
            if found.best is None or self._is_long_enough(found.best):
                if not self._go_on_outside(found, part_of(report, 0.8, 0.9)):
                    break
            elif not self._add(found.best, found, report):
                break
            elif self._end_to_beat and is_hopeless(self.model, self.errors, *self._end_to_beat):
                return
        self._prefer(part_of(progress, 1 - 0.6 ** (len(self.steps) - 1), 1.0))

    @property
    def is_doubtful(self) -> bool:
        """Whether nothing is missing at the end, and yet enough is left for an effect to be worth it."""
        last = self.diagnoses[-1]
        enough = last.thresholds.may_be_worth_adding(last.held_out.excess, self.ideal.excess)
        return last.verdict == "complete" and enough

    # --- what is known of the model

    def _is_long_enough(self, best: RankedEffect) -> bool:
        """Whether there are many effects, and the best of the others does not remove most of what is left."""
        return (
            len(self.model.names) >= MOST_EFFECTS and best.held_out.excess > (1 - MUCH) * self.errors.excess
        )

    @property
    def _limits(self) -> Thresholds:
        """As the last diagnosis has them, with the floor of the noise, and that of the model's values by pixel."""
        last = self.diagnoses[-1].thresholds if self.diagnoses else self._thresholds
        if self._noise is None or self._noise[0] is not self.model:
            self._noise = self.model, pixel_noise(self._captures, self.model)
        return replace(last, pixel_noise=self._noise[1])

    def _screened(self, progress: Progress) -> list[ScreenResult]:
        return screen_candidates(self._roles, self.model, self._known, self._pool, progress)

    def _diagnosed(
        self, progress: Progress | None = None, screened: Sequence[ScreenResult] | None = None
    ) -> Diagnosis:
        """What the model lacks; noted."""
        found = diagnose(
            self._captures,
            self.model,
            self._known,
            self._pool,
            self._thresholds,
            progress,
            self.ideal,
            thorough=False,
            screened=screened,
        )
        self.diagnoses.append(found)
        return found

    def _in_free_form(self, progress: Progress) -> tuple[str, Model, PredictionErrors] | None:
        """The effect whose map or curve goes on in free form, and the model with it; asked once of a model."""
        if self._asked is None or self._asked[0] is not self.model:
            progress(1.0, "looking whether maps and curves go on")
            found = _any_gone_on(self._roles, self.model, self.errors, self._limits)
            self._asked = self.model, found
        return self._asked[1]

    # --- steps

    def _took(self, *new: ExplanationStep) -> None:
        """Note the steps that led to the model, and save it."""
        self.steps.extend(new)
        if self._save:
            self._save(self.model)

    def _become(
        self,
        model: Model,
        errors: PredictionErrors,
        added: str | None = None,
        removed: str | None = None,
        refined: str | None = None,
        form: Mapping[str, str] | None = None,
        alike: tuple[str, ...] = (),
    ) -> None:
        """Take a model in one step, which its history has, too."""
        if refined is not None and form is None:
            form = form_of(model, refined)
        self.model = recorded(model, added, errors, removed, refined, form)
        self.errors = errors
        self._took(ExplanationStep(added, errors, alike, removed, refined, form or {}))

    def _first_look(self, progress: Progress) -> Diagnosis | None:
        """What a model lacks that is far away; None where it began with several effects at once."""
        looking = part_of(progress, 0, 0.3)
        screened = self._screened(looking)
        somewhere = is_expected_somewhere(self._roles, screened, self.errors)
        if not somewhere and self._begin_together(progress):
            return None
        found = self._diagnosed(looking, screened)
        alone = min((r.held_out.excess for r in found.ranking), default=math.inf)
        # The screen's straight lines may expect more of an effect than it then does.
        if somewhere and gets_nowhere(alone, self.errors) and self._begin_together(progress):
            self.diagnoses.pop()
            return None
        return found

    def _begin_together(self, progress: Progress) -> bool:
        """Begin with several effects at once where no single one gets anywhere; whether that leads anywhere."""
        together = explain_together(
            self._roles,
            self.model,
            self.errors,
            self._known,
            self._thresholds,
            self._pool,
            part_of(progress, 0.3, 0.4),
        )
        if together is None:
            return False
        history = self.model
        for name, errors in together.ladder:
            history = recorded(history, name, errors)
            self.errors = errors
        self.model = replace(together.model, history=history.history)
        self._took(*(ExplanationStep(*rung) for rung in together.ladder))
        return True

    def _look_again(self, progress: Progress) -> list[ScreenResult] | None:
        """Exchange effects for rivals, fit them anew or go on with them, and give the screen of what is lacking then.

        While one more effect is expected to explain the rest, there is no reason to doubt those that are present.
        """
        while not self._limits.complete(self.errors.excess, self.ideal.excess):
            screened = self._screened(progress)
            if expects_the_rest(screened):
                return screened
            progress(1.0, "looking whether another effect should stand in the place of one")
            better = exchanged(self._roles, self.model, self.errors, self._rivals, self._pool)
            if better is not None:
                old, new, model, errors = better
                del self._rivals[old]
                self._become(model, errors, added=new, removed=old)
                continue
            if not nothing_expects_much(screened):
                return screened
            progress(1.0, "looking whether an effect ends better from another start")
            anew = from_another_start(self._roles, self.model, self.errors, self._pool)
            if anew is not None and anew[2].excess < CLEARLY * self.errors.excess:
                name, model, errors = anew
                self._become(model, errors, refined=name, form=ANEW)
                continue
            further = self._in_free_form(progress)
            if further is None or further[2].excess > CLEARLY * self.errors.excess:
                return screened
            name, model, errors = further
            self._become(model, errors, refined=name)
        return None

    def _go_on_outside(self, found: Diagnosis, progress: Progress) -> bool:
        """Go on with a map or curve where something is missing that no effect explains; whether that pays."""
        outside = found.verdict == "outside_catalogue" and not below_the_noise(self.errors)
        further = self._in_free_form(progress) if outside else None
        if further is None:
            return False
        name, model, errors = further
        self._become(model, errors, refined=name)
        return True

    def _add(self, best: RankedEffect, found: Diagnosis, progress: Progress) -> bool:
        """Add the best effect or its rival, and take out what that makes unnecessary; whether it is worth adding."""
        progress(0.9, f"adding {best.effect.name}")
        best, model, after = chosen_addition(self._roles, found, self._pool)
        model, after = with_maps_again(self._roles, model, after)
        name, limits = best.effect.name, found.thresholds
        # A map whose next order did not help is looked at again only where nothing else fits.
        if next_order(model.instance(name)) is None:
            model, after = gone_on(self._roles, model, name, after, limits) or (model, after)
        if not limits.worth_adding(removed_excess(self.errors, after), self.ideal.excess, 1):
            return False
        self.forks.append(fork_at(len(self.steps), len(self.diagnoses) - 1, self.model, best, found.ranking))
        self._become(model, after, added=name, alike=best.indistinguishable_from)
        progress(0.95, "looking which effects are needed no longer")
        self._leave_out([n for n in self.model.names if n != name])
        self._rivals[name] = {
            r.effect.name: r.model.instance(r.effect.name)
            for r in found.ranking
            if r.worth_adding and r.effect.name != name
        }
        return True

    def _alike(self, name: str, step: ExplanationStep) -> dict[str, EffectInstance]:
        """Rivals of the effect that a step added: those that captures could not tell from it then, and plainer ones."""
        present = self.model.instance(name)
        return {
            n: rival
            for n, rival in self._rivals[name].items()
            if n in step.indistinguishable_from or rival.is_plainer_than(present)
        }

    def _leave_out(self, names: Sequence[str]) -> None:
        """Take out those of the named effects that the model does as well without, each in a step."""
        while smaller := without_one(
            self._roles, self.model, self.errors, names, self._limits, self.ideal.excess, self._pool
        ):
            dropped, model, errors = smaller
            names = [n for n in names if n != dropped]
            self._become(model, errors, removed=dropped)

    def _prefer(self, progress: Progress) -> None:
        """At the end, take what captures prefer to an effect, or what is plainer, and leave out what is not needed."""
        kept = self.model.names
        progress(0.8, "comparing effects with what could stand in their place")
        judged = self._limits, self.ideal.excess, self._pool
        alike = {
            s.added: self._alike(s.added, s)
            for s in self.steps
            if s.added in kept and s.added in self._rivals
        }
        if self.is_doubtful:  # enough is left for any rival in place of an effect to be worth it
            alike = dict(self._rivals)
        # Effects of a joint start have no rivals: they were fitted together, and their order says nothing.
        unsure = [
            after.added
            for before, after in pairwise(self.steps)
            if after.added in kept
            and after.added in self._rivals
            and after.held_out.excess > UNSURE * before.held_out.excess
        ]
        for name, plainer in plainer_rivals(self._roles, self.model, unsure, self._known, self._pool).items():
            alike[name] = {**plainer, **alike.get(name, {})}
        while better := preferred(self._roles, self.model, self.errors, alike, *judged):
            old, new, model, errors = better
            del alike[old]
            self._become(model, errors, added=new, removed=old)
        # A last pass: of every effect but the newest it is known already that the rest cannot do without it.
        newest = self.steps[-1].added
        if len(self.model.names) > 1:
            progress(0.9, "looking which effects are needed no longer")
            self._leave_out([newest] if newest else [])
            progress(0.95, "looking whether the others do without one from another start")
            while fewer := fewer_from_another_start(self._roles, self.model, self.errors, *judged):
                self._become(*fewer[1:], removed=fewer[0])
        # After that pass: one that is needed and one that is not are no reason to put a third in the place of both.
        simpler = one_for_two(self._roles, self.model, self.errors, self._rivals, *judged)
        if simpler is not None:
            new, old, other, model, errors = simpler
            self._become(model, errors, added=new, removed=old)
            self._become(self.model, errors, removed=other)
        while common := one_in_common(self._roles, self.model, self.errors, *judged):
            name, model, errors = common
            self._become(model, errors, refined=name, form=IN_COMMON)
        if self.model.names != kept or self.steps[-1].form == IN_COMMON:
            self._diagnosed()


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
