"""An explanation of captures: effects added one after the other until nothing more is worth adding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from runtime.program.progress import Progress, forward_only, no_progress, part_of
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.diagnosis import Diagnosis
from trainer.diagnosis.explanation_step import ExplanationStep
from trainer.diagnosis.learned_rest import LearnedRest, learn_rest
from trainer.diagnosis.second_way import doubtful, is_better
from trainer.diagnosis.verdict import Thresholds, below_the_noise
from trainer.diagnosis.way import Way
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.pool import Pool
from trainer.model.model import Model


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

    @property
    def suggested_captures(self) -> list[str]:
        """Captures that would tell more: of the last diagnosis, and of those whose effect is still there; sentences."""
        open_ones = [
            d
            for d in self.diagnoses
            if d is self.diagnosis or d.best is None or d.best.effect.name in self.model.names
        ]
        return list(dict.fromkeys(s for d in open_ones for s in d.suggested_captures))

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
            "suggested_captures": self.suggested_captures,
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
    way = Way(captures, model, known, pool, thresholds, save)
    way.go(report)
    found = Explanation(tuple(way.steps), way.model, way.diagnoses[-1], tuple(way.diagnoses))
    fork = doubtful(way.forks, way.model) if way.is_doubtful else None
    if fork is not None:
        others = {name: effect for name, effect in known.items() if name != fork.added}
        end = (way.model, way.errors)
        other = Way(captures, fork.before, others, pool, thresholds, end_to_beat=end)
        other.go(part_of(report, 0.95, 1.0, f"without {fork.added}"))
        if is_better(*end, other.model, other.errors, 1 - found.diagnosis.thresholds.level):
            steps = (*way.steps[: fork.step], *other.steps[1:])
            diagnoses = (*way.diagnoses[: fork.diagnosis], *other.diagnoses)
            found = Explanation(steps, other.model, diagnoses[-1], diagnoses)
            if save:
                save(found.model)
    if learn and found.diagnosis.verdict != "complete" and not below_the_noise(found.steps[-1].held_out):
        roles = capture_roles(captures)
        rest = learn_rest(roles, found.model, found.diagnosis, pool, part_of(report, 0.8, 1.0))
        found = replace(found, model=rest.model, learned=rest)
    report(1.0, "")
    return found
