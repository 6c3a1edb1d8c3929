"""What nothing named explains, learned at the stages that the probes name: the last rungs of an explanation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from runtime.excess import PredictionErrors, removed_excess
from runtime.program.progress import Progress, no_progress
from trainer.captures.held_out import CaptureRoles, split
from trainer.diagnosis.diagnosis import Diagnosis, probe_all
from trainer.diagnosis.probes import ProbeResult
from trainer.effects.definition import STAGES
from trainer.fitting.learned_stages import with_learned_stage
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.formatting import listed, number
from trainer.model.history import recorded
from trainer.model.model import Model

LEARNED_WELL = 2.0  # captures that were not learned from may err by this many times what the others do


@dataclass(frozen=True)
class LearnedRest:
    """A model with what was learned beyond its effects.

    Attributes
    ----------
    model : Model
    steps : tuple of (str, PredictionErrors)
        Stages in the order in which they were learned, each with the held-out errors after it.
    at_floor : bool
        Whether what is left is too little to explain.
    sentence : str
        What is left, and where it is not too little, why.
    """

    model: Model
    steps: tuple[tuple[str, PredictionErrors], ...]
    at_floor: bool
    sentence: str

    def as_json(self) -> dict[str, Any]:
        """The key `learned` of `explain --learn --json`: `steps`, `at_floor` and `sentence`."""
        rows = [{"stage": stage, **errors.as_json()} for stage, errors in self.steps]
        return {"steps": rows, "at_floor": self.at_floor, "sentence": self.sentence}


def learn_rest(
    roles: CaptureRoles, model: Model, found: Diagnosis, pool: Pool, progress: Progress | None = None
) -> LearnedRest:
    """Learn at one stage after the other, the one whose probe removes most first, while held-out captures gain.

    Parameters
    ----------
    model : Model
        With fitted gains.
    found : Diagnosis
        Of `model`.
    progress : callable, optional
        Called with the share that is done and what is being done.
    """
    report = progress or no_progress
    limits, ideal = found.thresholds, found.ideal_excess
    rows = split(roles.captures).fitted
    errors = evaluate_captures(roles.captures, roles.held_out, model)
    steps: list[tuple[str, PredictionErrors]] = []
    probes: Sequence[ProbeResult] = found.probes
    tried: list[str] = []
    while not limits.complete(errors.excess, ideal):
        probes = probes or probe_all(roles, model, errors, pool, no_progress)
        order = sorted(probes, key=lambda p: -p.removed.value)
        stages = [p.stage for p in order if p.stage not in tried and p.removed.value > 0]
        if not stages:
            break
        stage = stages[0]
        tried.append(stage)
        report((len(tried) - 1) / len(STAGES), f"learning at the {stage}")
        trial = with_learned_stage(roles.captures, rows, model, stage)
        after = evaluate_captures(roles.captures, roles.held_out, trial)
        if limits.worth_adding(removed_excess(errors, after), ideal, len(probes)):
            model, errors = recorded(trial, f"learned_{stage}", after), after
            steps.append((stage, after))
            probes = ()
    report(1.0, "")
    at_floor = limits.complete(errors.excess, ideal)
    return LearnedRest(model, tuple(steps), at_floor, _sentence(roles, model, steps, errors, at_floor))


def _sentence(
    roles: CaptureRoles,
    model: Model,
    steps: Sequence[tuple[str, PredictionErrors]],
    errors: PredictionErrors,
    at_floor: bool,
) -> str:
    learned = (
        f"Learned at the {listed([stage for stage, _ in steps])}" if steps else "Nothing could be learned"
    )
    left = f"{learned}: {number(errors.excess, 2)} of the signal's variance is left"
    if at_floor:
        return f"{left}, which is too little to explain."
    seen = evaluate_captures(roles.captures, roles.probed, model).excess
    if errors.excess > LEARNED_WELL * max(seen, 0):
        return (
            f"{left} on captures that were not learned from, and {number(seen, 2)} on the others: there are too few "
            "captures to learn it. Take more patterns."
        )
    return (
        f"{left}. No stage's free form takes it, so it is not the same in all captures, or it is finer than a pixel: "
        "look at where the model fails over time, with: hololoop-trainer compare"
    )
