"""Rounds of proposals: look at the probes, fit what they show, keep the best, and look again at what is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.excess import PredictionErrors, RemovedExcess, removed_excess
from runtime.program.progress import Progress, no_progress, part_of
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import CaptureRoles, capture_roles
from trainer.diagnosis.candidate_fits import CandidateFit, try_effect
from trainer.diagnosis.diagnosis import Diagnosis, diagnose, probe_all
from trainer.diagnosis.probes import ProbeResult
from trainer.diagnosis.proposals.candidates import Candidate, candidates_of, refinements_of
from trainer.diagnosis.proposals.effect_file import write_effect
from trainer.diagnosis.ranking import rank
from trainer.diagnosis.verdict import Thresholds, Verdict, below_the_noise, verdict_of
from trainer.effects.effect_catalogue import Catalogue, load_effects
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import settled
from trainer.formatting import number
from trainer.model.model import EffectInstance, Model, instance_with

ROUNDS = 4  # most proposals that are used together
MOST = 6  # files
ITERATIONS = 12


@dataclass(frozen=True)
class Proposal:
    """A proposed effect.

    Attributes
    ----------
    name : str
        Of the effect; its file is NAME.py.
    candidate : Candidate
    fitted : EffectInstance
        With its fitted numbers.
    excess_after : float
        Held-out excess with it, and with all proposals accepted before it.
    removed : RemovedExcess
        What it removes beyond these.
    worth_adding : bool
        Whether it was accepted: worth adding, and the best of its round.
    """

    name: str
    candidate: Candidate
    fitted: EffectInstance
    excess_after: float
    removed: RemovedExcess
    worth_adding: bool

    def as_json(self) -> dict[str, Any]:
        """A row of the key `proposals` of `propose --json`."""
        low, high = self.removed.interval()
        return {
            "file": f"{self.name}.py",
            "stage": self.candidate.place.stage,
            "what": self.candidate.reading.describe(self.fitted.values),
            "excess_after": self.excess_after,
            "excess_removed": self.removed.value,
            "ci95": [low, high],
            "worth_adding": self.worth_adding,
        }

    def write(self, folder: Path) -> Path:
        """Write its file, and check that it loads."""
        path = folder / f"{self.name}.py"
        write_effect(path, self.name, self.candidate.place, self.candidate.reading, self.fitted.values)
        load_effects(path)
        return path


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
        if found.verdict == "missing":
            assert found.best is not None
            return f"{found.sentence} Add {found.best.effect.name} first; then look at what has no name."
        if not accepted or self.left is None:
            if below_the_noise(found.held_out):
                return found.sentence
            return f"{found.sentence} No shape that was read off the probes is worth adding."
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
    found = diagnose(captures, model, known, pool, thresholds, part_of(report, 0, 0.4), with_probes=False)
    if found.verdict != "outside_catalogue" or not found.probes:
        report(1.0, "done")
        return Proposals(found)
    work = _Work(capture_roles(captures), known, pool, drafts, thresholds, found.ideal_excess)
    current, errors, probes = found.model, found.held_out, list(found.probes)
    accepted: list[Proposal] = []
    others: list[Proposal] = []
    for count in range(ROUNDS):
        part = part_of(report, 1 - 0.6 * 0.45**count, 1 - 0.6 * 0.45 ** (count + 1), f"round {count + 1}")
        best, rest, step = work.round(current, errors, probes, part)
        others += rest
        if best is None or step is None:
            break
        accepted.append(best)
        current, errors = step
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


@dataclass
class _Work:
    """What all rounds share."""

    roles: CaptureRoles
    known: Catalogue
    pool: Pool
    drafts: Path
    thresholds: Thresholds
    ideal_excess: float
    taken: set[str] = field(default_factory=set)

    def round(
        self, model: Model, before: PredictionErrors, probes: Sequence[ProbeResult], report: Progress
    ) -> tuple[Proposal | None, list[Proposal], tuple[Model, PredictionErrors] | None]:
        """The best proposal, the others that were fitted, and the model with the best and its errors."""
        telling = [
            p for p in probes if self.thresholds.worth_adding(p.removed, self.ideal_excess, len(probes))
        ]
        signal = float(np.sqrt(before.variance.sum() / max(before.pixels.sum(), 1)))
        candidates = candidates_of(telling, model.bench, signal, part_of(report, 0, 0.1))
        if not candidates:
            return None, [], None
        fits = self._fitted(model, candidates, part_of(report, 0.1, 0.6, "fitting what the probes show"))
        best = self._best(before, fits)
        if best is not None and not self.thresholds.complete(
            fits[best][1].held_out.excess, self.ideal_excess
        ):
            more = refinements_of(fits[best][0], telling, model.bench, signal)
            fits = {**fits, **self._fitted(model, more, part_of(report, 0.6, 0.8, "refining the best"))}
            best = self._best(before, fits)
        rest = [
            self._proposal(n, c, f.model, f.held_out, before, False)
            for n, (c, f) in fits.items()
            if n != best and f.held_out.excess < before.excess
        ]
        if best is None:
            return None, rest, None
        candidate, fit = fits[best]
        together = fit.model
        errors = fit.held_out
        if len(together.names) > 1:
            report(0.8, "fitting all effects together")
            joint = settled(together, load(self.roles.captures, self.roles.fitted)).model
            after = evaluate_captures(self.roles.captures, self.roles.held_out, joint)
            if after.excess < errors.excess:
                together, errors = joint, after
        return (
            self._proposal(best, candidate, together, errors, before, True),
            rest,
            (together, errors),
        )

    def _best(self, before: PredictionErrors, fits: dict[str, tuple[Candidate, CandidateFit]]) -> str | None:
        """The name of the fit to accept: of those that the captures cannot tell apart, the one of fewest numbers."""
        if not fits:
            return None
        effects = {**self.known, **{n: f.model.instance(n).effect for n, (_, f) in fits.items()}}
        ranked = rank(
            before,
            [f for _, f in fits.values()],
            effects,
            self.thresholds,
            self.ideal_excess,
            len(fits),
        )
        if not ranked or not ranked[0].worth_adding:
            return None
        alike = [ranked[0].effect.name, *ranked[0].indistinguishable_from]
        return min(alike, key=lambda n: fits[n][0].reading.size)

    def _fitted(
        self, model: Model, candidates: Sequence[Candidate], report: Progress
    ) -> dict[str, tuple[Candidate, CandidateFit]]:
        """Candidates as effects in the model, by name; those whose file does not load or fit are left out."""
        ids = tuple(c.capture for c in self.roles.fitted)
        held = tuple(c.capture for c in self.roles.held_out)
        named: dict[str, Candidate] = {}
        tasks = []
        for candidate in candidates:
            name = candidate.name({*self.known, *self.taken, *model.names})
            self.taken.add(name)
            path = self.drafts / f"{name}.py"
            write_effect(path, name, candidate.place, candidate.reading)
            try:
                (effect,) = load_effects(path)
            except InputError:
                continue
            named[name] = candidate
            start = instance_with(effect, model.bench, candidate.reading.starts)
            tasks.append((self.roles.folder, ids, held, model, start, False, ITERATIONS))
        results = self.pool.map(try_draft, tasks, lambda done: report(done / max(1, len(tasks))))
        return {f.effect: (named[f.effect], f) for f in results if f is not None}

    def _proposal(
        self,
        name: str,
        candidate: Candidate,
        model: Model,
        after: PredictionErrors,
        before: PredictionErrors,
        accepted: bool,
    ) -> Proposal:
        removed = removed_excess(before, after)
        return Proposal(name, candidate, model.instance(name), after.excess, removed, accepted)


def try_draft(*task: Any) -> CandidateFit | None:
    """The task of `try_effect`; None where the effect cannot be fitted."""
    try:
        return try_effect(*task)
    except (InputError, ArithmeticError, np.linalg.LinAlgError):
        return None
