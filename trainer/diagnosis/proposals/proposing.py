"""Rounds of proposals: look at the probes, fit what they show, keep the best, and look again at what is left."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from runtime.excess import PredictionErrors
from runtime.program.progress import Progress, no_progress, part_of
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.diagnosis import Diagnosis, diagnose, probe_all
from trainer.diagnosis.proposals.proposal_rounds import Proposal, RoundWork
from trainer.diagnosis.verdict import Thresholds, Verdict, below_the_noise, verdict_of
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.pool import Pool
from trainer.formatting import number
from trainer.model.model import Model

ROUNDS = 4  # most proposals that are used together
MOST = 6  # files
SMALL_PART = 0.1  # of the excess: a named effect that explains less than this does not name what is missing


@dataclass(frozen=True)
class Proposals:
    """What is proposed for a capture set.

    Attributes
    ----------
    diagnosis : Diagnosis
        Of the model that was given.
    proposals : tuple of Proposal
        Accepted ones first, in the order in which they go into the model; then what was fitted and not accepted.
    left : PredictionErrors
        Held-out errors with all accepted proposals.
    verdict_left : Verdict
        On what remains with them; "missing" cannot be: named effects were tried first.
    """

    diagnosis: Diagnosis
    proposals: tuple[Proposal, ...] = field(default=())
    left: PredictionErrors | None = None
    verdict_left: Verdict = "outside_catalogue"

    @property
    def sentence(self) -> str:
        """What was found, in one or two sentences."""
        found = self.diagnosis
        accepted = [p for p in self.proposals if p.worth_adding]
        if found.verdict == "complete":
            return f"{found.sentence} Nothing needs to be proposed."
        if found.best is not None and not has_no_name(found):
            return f"{found.sentence} Add {found.best.effect.name} first; then look at what has no name."
        if not accepted or self.left is None:
            if below_the_noise(found.held_out):
                return found.sentence
            none = "No shape that was read off the probes is worth adding"
            return f"{found.sentence} {none}{f': add {found.best.effect.name}' if found.best else ''}."
        before, after = number(found.held_out.excess, 2), number(self.left.excess, 2)
        names = " and ".join(p.name for p in accepted)
        together = " together" if len(accepted) > 1 else ""
        rest = (
            "which is complete."
            if self.verdict_left == "complete"
            else "and something without a shape is left."
        )
        verb = "take" if len(accepted) > 1 else "takes"
        return f"{names}{together} {verb} the excess from {before} to {after}, {rest}"

    def as_json(self) -> dict[str, Any]:
        """The object that `propose --json` prints.

        Keys `proposals` and `verdict`, and `sentence`, `heldout` and `left`. `verdict` is that of the given model,
        `heldout` its errors; `left` are the errors and the verdict with the accepted proposals.
        """
        left = self.left or self.diagnosis.held_out
        return {
            "proposals": [p.as_json() for p in self.proposals],
            "verdict": self.diagnosis.verdict,
            "heldout": self.diagnosis.held_out.as_json(),
            "left": {
                **left.as_json(),
                "verdict": self.verdict_left if self.left else self.diagnosis.verdict,
            },
            "sentence": self.sentence,
        }


def has_no_name(found: Diagnosis) -> bool:
    """Whether most of what a diagnosed model lacks is in no catalogue.

    A shape that no effect has may by chance look a little like one that has a name: the low orders of random columns
    look like a beam that is not uniform.
    """
    if found.verdict == "complete" or below_the_noise(found.held_out):
        return False
    return found.best is None or found.best.removed.value < SMALL_PART * found.held_out.excess


def propose(
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    drafts: Path,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
) -> Proposals:
    """Effects for what has no name, in rounds.

    In each round the stages' fitted probes are looked at for shapes, each shape is fitted as an effect and judged on
    held-out captures, and the best one is accepted if it is worth adding. The next round looks at what is left.

    Parameters
    ----------
    known : Catalogue
        Named effects, which come first.
    drafts : Path
        A folder for the drafts' files, which every worker must see.
    progress : callable, optional
        Called with the share that is done and what is being done.
    """
    thresholds = thresholds or Thresholds()
    report = progress or no_progress
    found = diagnose(captures, model, known, pool, thresholds, part_of(report, 0, 0.4), thorough=False)
    if not has_no_name(found):
        report(1.0, "done")
        return Proposals(found)
    thresholds = found.thresholds  # with what the captures themselves cannot tell
    work = RoundWork(capture_roles(captures), known, pool, drafts, thresholds, found.ideal_excess)
    current, errors = found.model, found.held_out
    report(0.4, "probing the stages")
    probes = list(found.probes) or probe_all(work.roles, current, errors, pool, no_progress)
    accepted: list[Proposal] = []
    others: list[Proposal] = []
    for count in range(ROUNDS):
        part = part_of(report, 1 - 0.6 * 0.45**count, 1 - 0.6 * 0.45 ** (count + 1), f"round {count + 1}")
        step = work.round(current, errors, probes, part)
        others += step.others
        if step.best is None:
            break
        accepted.append(step.best)
        current, errors = step.model, step.errors
        if thresholds.complete(errors.excess, found.ideal_excess) or count + 1 == ROUNDS:
            break
        probes = probe_all(work.roles, current, errors, pool, no_progress)
    last = [
        Proposal(p.name, p.candidate, current.instance(p.name), p.excess_after, p.removed, p.worth_adding)
        for p in accepted
    ]
    others.sort(key=lambda p: p.excess_after)
    complete = thresholds.complete(errors.excess, found.ideal_excess)
    report(1.0, "done")
    return Proposals(found, (*last, *others)[: max(MOST, len(last))], errors, verdict_of(complete, False))
