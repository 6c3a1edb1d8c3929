"""One round of proposals: what the probes show is fitted, the best is accepted, and more of its kind is looked for."""

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
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.candidate_fits import CandidateFit, try_effect
from trainer.diagnosis.probes import ProbeResult, probe
from trainer.diagnosis.proposals.effect_file import write_effect
from trainer.diagnosis.proposals.in_time import candidates_in_time
from trainer.diagnosis.proposals.shapes_tried import WEAK, Candidate, candidates_of, more_of
from trainer.diagnosis.ranking import rank
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import Catalogue, load_effects
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import settled
from trainer.model.model import EffectInstance, Model, instance_with

ITERATIONS = 12
ENOUGH = 3e-4  # excess below which a shape is not looked at more closely
MORE = 2  # times that further specks are looked for
BETTER = 0.9  # of the excess: what more of a kind must leave at most

Fits = dict[str, tuple[Candidate, CandidateFit]]


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
class Round:
    """What a round gave.

    Attributes
    ----------
    best : Proposal or None
        The accepted one.
    others : tuple of Proposal
        Fitted, and not accepted.
    model : Model
        With the accepted one, everything fitted together.
    errors : PredictionErrors
        Of `model` on the held-out captures.
    """

    best: Proposal | None
    others: tuple[Proposal, ...]
    model: Model
    errors: PredictionErrors


@dataclass
class RoundWork:
    """What all rounds share.

    Attributes
    ----------
    known : Catalogue
        Effects whose names are taken.
    drafts : Path
        A folder for the drafts' files, which every worker must see.
    taken : set of str
        Names of proposals so far.
    written : int
        Drafts so far.
    """

    roles: CaptureRoles
    known: Catalogue
    pool: Pool
    drafts: Path
    thresholds: Thresholds
    ideal_excess: float
    taken: set[str] = field(default_factory=set)
    written: int = 0

    def round(
        self, model: Model, before: PredictionErrors, probes: Sequence[ProbeResult], report: Progress
    ) -> Round:
        """Fit what the probes of a model show, and accept the best if it is worth adding."""
        telling = [
            p for p in probes if self.thresholds.worth_adding(p.removed, self.ideal_excess, len(probes))
        ]
        signal = float(np.sqrt(before.variance.sum() / max(before.pixels.sum(), 1)))
        steady = candidates_of(telling, model.bench, signal, part_of(report, 0, 0.05))
        report(0.05, "looking at what changes from capture to capture")
        candidates = [*steady, *candidates_in_time(self.roles, model, self.pool, steady)]
        candidates = [c for c in candidates if c.worth > WEAK * max(o.worth for o in candidates)]
        fits = self._fitted(model, candidates, part_of(report, 0.1, 0.6, "fitting what the probes show"))
        best = self._best(before, fits)
        others = tuple(
            _proposal(n, c, f.model, f.held_out, before, False)
            for n, (c, f) in fits.items()
            if n != best and f.held_out.excess < before.excess
        )
        if best is None:
            return Round(None, others, model, before)
        report(0.6, "fitting all effects together")
        candidate = fits[best][0]
        together, errors = self._together(fits[best][1])
        for k in range(MORE):
            if errors.excess <= ENOUGH or candidate.reading.name != "specks":
                break
            report(0.7 + 0.3 * k / MORE, "looking closer at the specks")
            grown = self._grown(together, errors, best, candidate)
            if grown is None:
                break
            candidate, (together, errors) = grown
        return Round(_proposal(best, candidate, together, errors, before, True), others, together, errors)

    def _together(self, fit: CandidateFit) -> tuple[Model, PredictionErrors]:
        """A fitted model with all of its effects fitted together, where that is better; and its errors."""
        if len(fit.model.names) < 2:
            return fit.model, fit.held_out
        rows = self.roles.probed if fit.model.in_time else self.roles.fitted
        joint = settled(fit.model, load(self.roles.captures, rows)).model
        after = evaluate_captures(self.roles.captures, self.roles.held_out, joint)
        return (joint, after) if after.excess < fit.held_out.excess else (fit.model, fit.held_out)

    def _grown(
        self, model: Model, errors: PredictionErrors, name: str, candidate: Candidate
    ) -> tuple[Candidate, tuple[Model, PredictionErrors]] | None:
        """The specks with those that a probe of what is left shows, or each with its own transmission.

        None where neither is clearly better.
        """
        (found,) = self.pool.map(
            probe, [(self.roles.folder, self._probed, self._held, model, candidate.place.probe)]
        )
        left = ProbeResult.judged(found, errors)
        values = model.instance(name).values
        for own in (False, True):
            if own and self.thresholds.complete(errors.excess, self.ideal_excess):
                break
            more = more_of(candidate, left, model.bench, values, own)
            fits = {} if more is None else self._fitted(model.without(name), [more], no_progress, name)
            if more is None or name not in fits:
                continue
            grown = self._together(fits[name][1])
            if grown[1].excess < BETTER * errors.excess:
                return more, grown
        return None

    @property
    def _held(self) -> tuple[str, ...]:
        return ids_of(self.roles.held_out)

    @property
    def _probed(self) -> tuple[str, ...]:
        return ids_of(self.roles.probed)

    def _best(self, before: PredictionErrors, fits: Fits) -> str | None:
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
        self, model: Model, candidates: Sequence[Candidate], report: Progress, name: str = ""
    ) -> Fits:
        """Candidates as effects in the model, by name; those whose file does not load or fit are left out."""
        few, more = ids_of(self.roles.fitted), ids_of(self.roles.probed)
        named: dict[str, Candidate] = {}
        tasks = []
        for candidate in candidates:
            own = name or candidate.name({*self.known, *self.taken, *model.names})
            self.taken.add(own)
            self.written += 1
            path = self.drafts / f"{own}_draft_{self.written}.py"  # a file is read once in each process
            write_effect(path, own, candidate.place, candidate.reading)
            try:
                (effect,) = load_effects(path)
            except InputError:
                continue
            named[own] = candidate
            start = instance_with(effect, model.bench, candidate.reading.starts)
            ids = more if effect.takes_moment else few
            tasks.append((self.roles.folder, ids, self._held, model, start, False, ITERATIONS))
        results = self.pool.map(try_draft, tasks, lambda done: report(done / max(1, len(tasks))))
        return {f.effect: (named[f.effect], f) for f in results if f is not None}


def _proposal(
    name: str,
    candidate: Candidate,
    model: Model,
    after: PredictionErrors,
    before: PredictionErrors,
    accepted: bool,
) -> Proposal:
    return Proposal(
        name, candidate, model.instance(name), after.excess, removed_excess(before, after), accepted
    )


def try_draft(*task: Any) -> CandidateFit | None:
    """The task of `try_effect`; None where the effect cannot be fitted."""
    try:
        return try_effect(*task)
    except (InputError, ArithmeticError, np.linalg.LinAlgError):
        return None
