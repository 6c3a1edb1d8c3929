"""The diagnosis of a model: which stage and which effect it lacks, judged on held-out captures."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from runtime.excess import PredictionErrors
from runtime.program.progress import Progress, no_progress
from trainer.captures.bench_file import Camera
from trainer.captures.camera_numbers import camera_of_residual
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles, capture_roles
from trainer.diagnosis.bench_facts import EqualFact, EqualFacts, camera_facts, equal_facts
from trainer.diagnosis.fitted_ranking import fitted_ranking
from trainer.diagnosis.previews import CandidatePreview, previews
from trainer.diagnosis.probes import ProbeResult, probe
from trainer.diagnosis.ranking import RankedEffect
from trainer.diagnosis.screen import ScreenResult
from trainer.diagnosis.screening import screen_candidates
from trainer.diagnosis.separate import captures_that_separate
from trainer.diagnosis.table_facts import DRIFT, exposure_facts, facts_sentence, plane_facts
from trainer.diagnosis.verdict import Thresholds, below_the_noise, noise_floor, verdict_of
from trainer.effects.definition import STAGES
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.pixel_values import pixel_noise
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.formatting import number
from trainer.model.model import Model
from trainer.model.parameters import describe


@dataclass(frozen=True)
class Diagnosis:
    """What is missing from a model, how sure that is, and which captures would say more.

    Attributes
    ----------
    model : Model
        As it was diagnosed, with its gains.
    held_out : PredictionErrors
        Its errors on the held-out captures.
    ideal_excess : float
        Held-out excess of the bench file's own model.
    verdict : str
        "complete", "missing" or "outside_catalogue".
    stage : str or None
        Where the missing physics is; None where the model is complete or no probe shows it.
    ranking : tuple of RankedEffect
        Fitted candidates, best first.
    screened : tuple of ScreenResult
        All candidates by what the screen expects of them, best first.
    is_held_out : bool
        False where there is only one pattern, so that what is judged is what was fitted.
    equal_facts : EqualFacts
        Facts of bench.toml that would explain the captures as well as the model's, or the best candidate's, distance
        or wavelength does.
    table_facts : tuple of EqualFact
        Planes and exposures of captures.csv that the captures contradict, with what they should be.
    camera_facts : tuple of EqualFact
        Numbers of bench.toml's camera that repeated captures contradict.
    """

    model: Model
    held_out: PredictionErrors
    ideal_excess: float
    verdict: str
    stage: str | None
    ranking: tuple[RankedEffect, ...]
    probes: tuple[ProbeResult, ...]
    suggested_captures: tuple[str, ...]
    thresholds: Thresholds
    screened: tuple[ScreenResult, ...] = field(default=())
    is_held_out: bool = True
    equal_facts: EqualFacts = field(default_factory=EqualFacts)
    previews: tuple[CandidatePreview, ...] = ()
    table_facts: tuple[EqualFact, ...] = ()
    camera_facts: tuple[EqualFact, ...] = ()

    @property
    def best(self) -> RankedEffect | None:
        """The effect to add, if one is worth adding."""
        return self.ranking[0] if self.ranking and self.ranking[0].worth_adding else None

    @property
    def probe_pictures(self) -> list[tuple[str, str, np.ndarray, str]]:
        """(stage, title, array, unit) of what the free-form probes found, where they found anything."""
        found = [p for p in self.probes if p.removed.value > 0.01 * self.held_out.excess]
        return [(p.stage, *picture) for p in found for picture in p.pictures]

    @property
    def sentence(self) -> str:
        """The verdict in one sentence, and what is to be corrected in captures.csv."""
        return f"{self._verdict_sentence} {facts_sentence(self.table_facts)}".rstrip()

    @property
    def _verdict_sentence(self) -> str:
        left = number(self.held_out.excess, 2)
        if below_the_noise(self.held_out):
            return overstated_noise(self.held_out, self.model.bench.camera)
        if self.verdict == "complete":
            also = ""
            if self.best is not None:
                share = 100 * self.best.removed.value / max(self.held_out.excess, 1e-12)
                also = f" {self.best.effect.name} would explain {min(share, 100):.0f} % of that."
            noise = self.thresholds.pixel_noise
            if noise:
                also += f" The noise in each pixel's own values is {number(noise, 2)} of it."
            return (
                f"Nothing is missing: what remains above the camera's noise is {left} of the signal's variance."
                + also
                + f" {self.equal_facts.sentence}".rstrip()
            )
        if self.best is None:
            where = f" It is at the {self.stage} stage." if self.stage else " No stage's probe shows where."
            return f"Something is missing that the catalogue does not name (excess {left}).{where}"
        best = self.best
        size = describe(best.model.instance(best.effect.name), best.model.bench)
        share = 100 * best.removed.value / max(self.held_out.excess, 1e-12)
        also = ""
        if best.indistinguishable_from:
            also = f" These captures cannot tell it from {' or '.join(best.indistinguishable_from)}."
        if self.equal_facts.facts:
            also += f" {self.equal_facts.sentence}"
        gain = f"it explains {min(share, 100):.0f} % of the excess {left}"
        return f"{best.effect.name} is missing ({size}): {gain}.{also}"

    def as_json(self) -> dict[str, Any]:
        """The object that `diagnose --json` prints.

        Keys `heldout`, `held_out` (false where the captures hold one pattern), `verdict`, `stage`, `stages`,
        `ranking`, `suggested_captures`, `ideal_excess`, `thresholds`,
        `screen`, `equal_facts`, `table_facts`, `camera_facts` and `sentence`.
        """
        return {
            "heldout": self.held_out.as_json(),
            "held_out": self.is_held_out,
            "verdict": self.verdict,
            "stage": self.stage,
            "stages": [p.as_json() for p in self.probes],
            "ranking": [r.as_json() for r in self.ranking],
            "suggested_captures": list(self.suggested_captures),
            "ideal_excess": self.ideal_excess,
            "thresholds": self.thresholds.as_json(),
            "screen": [{"effect": s.effect, "excess_removed": s.removed_excess} for s in self.screened],
            "equal_facts": [f.as_json() for f in self.equal_facts.facts],
            "table_facts": [f.as_json() for f in self.table_facts],
            "camera_facts": [f.as_json() for f in self.camera_facts],
            "sentence": self.sentence,
        }


def with_previews(captures: CaptureSet, found: Diagnosis) -> Diagnosis:
    """A diagnosis of captures with what its best candidates would change in a picture."""
    return replace(found, previews=tuple(previews(captures, found.model, found.ranking)))


def overstated_noise(errors: PredictionErrors, camera: Camera) -> str:
    """What to change where a model errs by less than the stated noise, in one sentence."""
    share = float(errors.squared.sum() / errors.noise.sum())
    shown = camera_of_residual(errors, camera)
    found = f" (what remains shows full_well_e = {shown.full_well_e:.3g})" if shown else ""
    excess = number(errors.excess, 2)
    return (
        f"The camera's numbers are wrong: the model's squared error is {share:.2g} of what the stated noise alone "
        f"would be (excess {excess}), so nothing can be said of what is missing. Correct full_well_e = "
        f"{camera.full_well_e:g}, read_noise_e = {camera.read_noise_e:g} or bit_depth = {camera.bit_depth} in "
        f"bench.toml{found}, or capture one pattern twice to have the noise measured."
    )


def ideal_errors(roles: CaptureRoles, model: Model) -> PredictionErrors:
    """Held-out errors of the bench file's own model."""
    ideal = with_gains(roles.captures, Model(model.bench, method=model.method), roles.fitted)
    return evaluate_captures(roles.captures, roles.held_out, ideal)


def diagnose(
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    ideal: PredictionErrors | None = None,
    thorough: bool = True,
    screened: Sequence[ScreenResult] | None = None,
) -> Diagnosis:
    """What is missing from `model` on a capture set.

    Parameters
    ----------
    known : Catalogue
        Effects to try, by name; those in the model are left out.
    progress : callable, optional
        Called with the share that is done and what is being done.
    ideal : PredictionErrors, optional
        The ideal model's held-out errors, where they are known.
    thorough : bool
        False leaves out what the next step of an explanation does not need: the stages' free-form probes and the
        distances of single planes unless nothing named fits, candidates that `fitted_ranking` leaves out then, and
        all of it for a complete model.
    screened : sequence of ScreenResult, optional
        What `screen_candidates` says of this very model, where it was asked before.
    """
    thresholds = thresholds or Thresholds()
    report = progress or no_progress
    roles = capture_roles(captures)
    report(0.0, "comparing the model with held-out captures")
    model = with_gains(captures, model, roles.fitted)
    before = evaluate_captures(captures, roles.held_out, model)
    ideal_excess = (ideal or (before if not model.present else ideal_errors(roles, model))).excess
    thresholds = replace(
        thresholds, floor=noise_floor(captures, before), pixel_noise=pixel_noise(captures, model)
    )
    complete = thresholds.complete(before.excess, ideal_excess)
    little = complete and not thresholds.may_be_worth_adding(before.excess, ideal_excess)

    overstated = below_the_noise(before)
    if overstated or (little and not thorough):
        same = equal_facts(model, captures)
        return Diagnosis(
            model,
            before,
            ideal_excess,
            "outside_catalogue" if overstated else "complete",
            None,
            (),
            (),
            tuple(same.deciding_captures),
            thresholds,
            is_held_out=roles.is_held_out,
            equal_facts=same,
            table_facts=_exposures(roles, model, model.names),
            camera_facts=camera_facts(captures),
        )

    if screened is None:
        screened = screen_candidates(roles, model, known, pool, report)
    order = sorted(screened, key=lambda s: -s.removed_excess)
    ranking, fits = fitted_ranking(
        roles, model, before, order, known, pool, thresholds, ideal_excess, thorough, report
    )
    verdict = verdict_of(complete, bool(ranking) and ranking[0].worth_adding)

    probes: list[ProbeResult] = []
    if thorough or verdict == "outside_catalogue":
        probes = probe_all(roles, model, before, pool, report)
    stage = None
    if verdict == "missing":
        stage = ranking[0].effect.stage
    elif verdict == "outside_catalogue":
        # A probe of a few thousand numbers that removes nothing on held-out captures points nowhere.
        telling = [p for p in probes if thresholds.worth_adding(p.removed, ideal_excess, len(probes))]
        stage = max(telling, key=lambda p: p.removed.value).stage if telling else None
    table: tuple[EqualFact, ...] = ()
    if verdict == "outside_catalogue" or (thorough and verdict == "missing"):
        best = min([before, *(f.held_out for f in fits)], key=lambda e: e.excess)
        table = plane_facts(roles, model, best, known, pool, thresholds, ideal_excess)
    drifts = [f.effect for f in fits if f.held_out.excess < before.excess]
    table += _exposures(roles, model, (*model.names, *drifts))
    same = equal_facts(ranking[0].model if verdict == "missing" else model, captures)
    suggestions = same.deciding_captures + suggest(roles, verdict, ranking)
    report(1.0, "")
    return Diagnosis(
        model,
        before,
        ideal_excess,
        verdict,
        stage,
        tuple(ranking),
        tuple(probes),
        tuple(suggestions),
        thresholds,
        tuple(order),
        roles.is_held_out,
        same,
        table_facts=table,
        camera_facts=camera_facts(captures),
    )


def _exposures(roles: CaptureRoles, model: Model, names: Collection[str]) -> tuple[EqualFact, ...]:
    """Exposures that captures.csv states wrongly, where a gain of each capture is among the effects that help."""
    rows = {c.capture: c for c in (*roles.fitted, *roles.held_out)}
    return exposure_facts(roles.captures, tuple(rows.values()), model) if DRIFT in names else ()


def probe_all(
    roles: CaptureRoles, model: Model, before: PredictionErrors, pool: Pool, report: Progress
) -> list[ProbeResult]:
    """Fit each stage's free-form probe alone."""
    ids, held = ids_of(roles.probed), ids_of(roles.held_out)
    tasks = [(roles.folder, ids, held, model, stage) for stage in STAGES]
    report(0.7, "probing the stages")
    found = pool.map(probe, tasks, lambda n: report(0.7 + 0.25 * n / len(tasks), "probing the stages"))
    return [ProbeResult.judged(p, before) for p in found]


def suggest(roles: CaptureRoles, verdict: str, ranking: Sequence[RankedEffect]) -> list[str]:
    """Captures that would say more, the best first, as sentences."""
    suggestions: list[str] = []
    if verdict == "missing" and ranking[0].indistinguishable_from:
        alike = {r.effect.name: r.model for r in ranking}
        for other in ranking[0].indistinguishable_from:
            suggestions += captures_that_separate(
                roles, (ranking[0].effect.name, ranking[0].model), (other, alike[other])
            )
    patterns = [c.pattern for c in roles.captures.captures]
    if len(set(patterns)) == len(patterns):
        suggestions.append(
            "one pattern captured twice: without a repeat the camera's noise cannot be checked"
        )
    return list(dict.fromkeys(suggestions))
