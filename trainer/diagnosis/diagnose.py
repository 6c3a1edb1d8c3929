"""Which stage, which effect: what is missing from a model, ranked by what it explains on held-out captures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from runtime.excess import PredictionErrors, RemovedExcess, removed_excess
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import CaptureRoles, capture_roles
from trainer.diagnosis.candidates import CandidateFit, try_effect, try_together
from trainer.diagnosis.probes import ProbeResult, probe
from trainer.diagnosis.screen import ScreenResult, screen
from trainer.diagnosis.separate import captures_that_separate
from trainer.diagnosis.verdict import Thresholds, verdict_of
from trainer.effects.definition import STAGES, Effect
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import evaluate_captures
from trainer.formatting import number
from trainer.model.model import Model
from trainer.model.parameters import describe, json_values

Progress = Callable[[float, str], None]

FIRST_TRIED = 5  # candidates fitted after the screen; all of them when none of these explains anything
TRIED_TOGETHER = 3  # candidates fitted with the present effects free, when none explains anything beside them


@dataclass(frozen=True)
class RankedEffect:
    """A candidate in the ranking."""

    effect: Effect
    model: Model
    held_out: PredictionErrors
    removed: RemovedExcess
    worth: bool
    indistinguishable_from: tuple[str, ...] = ()

    @property
    def base(self) -> Model:
        """The model without the candidate; other effects as they are beside it."""
        return self.model.without(self.effect.name)

    def as_json(self) -> dict[str, Any]:
        """The contract's keys."""
        low, high = self.removed.interval()
        return {
            "effect": self.effect.name,
            "stage": self.effect.stage,
            "excess_after": self.held_out.excess,
            "excess_removed": self.removed.value,
            "ci95": [low, high],
            "worth_adding": self.worth,
            "parameters": json_values(self.model.instance(self.effect.name), self.model.bench),
            "indistinguishable_from": list(self.indistinguishable_from),
        }


@dataclass(frozen=True)
class Diagnosis:
    """What is missing, how sure that is, and what would tell more."""

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

    @property
    def best(self) -> RankedEffect | None:
        """The effect to add, if one is worth adding."""
        return self.ranking[0] if self.ranking and self.ranking[0].worth else None

    @property
    def probe_pictures(self) -> list[tuple[str, str, np.ndarray, str]]:
        """(stage, title, array, unit) of what the free-form probes found, where they found anything."""
        found = [p for p in self.probes if p.removed.value > 0.01 * self.held_out.excess]
        return [(p.stage, *picture) for p in found for picture in p.pictures]

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        left = number(self.held_out.excess, 2)
        if self.verdict == "complete":
            return f"Nothing is missing: what remains above the camera's noise is {left} of the signal's variance."
        if self.best is None:
            where = (
                f" The {self.stage} stage is where it sits."
                if self.stage
                else " No stage's probe shows where."
            )
            return f"Something is missing that the catalogue does not name (excess {left}).{where}"
        best = self.best
        size = describe(best.model.instance(best.effect.name), best.model.bench)
        share = 100 * best.removed.value / max(self.held_out.excess, 1e-12)
        also = ""
        if best.indistinguishable_from:
            also = f" These captures cannot tell it from {' or '.join(best.indistinguishable_from)}."
        gain = f"it explains {min(share, 100):.0f} % of the excess {left}"
        return f"{best.effect.name} is missing ({size}): {gain}.{also}"

    def as_json(self) -> dict[str, Any]:
        """The contract's keys, and the thresholds and the sentence."""
        return {
            "heldout": self.held_out.as_json(),
            "verdict": self.verdict,
            "stage": self.stage,
            "stages": [p.as_json() for p in self.probes],
            "ranking": [r.as_json() for r in self.ranking],
            "suggested_captures": list(self.suggested_captures),
            "ideal_excess": self.ideal_excess,
            "thresholds": self.thresholds.as_json(),
            "screen": [{"effect": s.effect, "excess_removed": s.removed_excess} for s in self.screened],
            "sentence": self.sentence,
        }


def ideal_errors(parts: CaptureRoles, model: Model) -> PredictionErrors:
    """Held-out errors of the bench file's own model."""
    ideal = with_gains(parts.captures, Model(model.bench, method=model.method), parts.fitted)
    return evaluate_captures(parts.captures, parts.held_out, ideal)


def diagnose(
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    ideal: PredictionErrors | None = None,
    with_probes: bool = True,
) -> Diagnosis:
    """What is missing from `model` on a capture set.

    `ideal`: the ideal model's held-out errors, if they are known. `with_probes=False` leaves out what the verdict
    does not need: the stages' free-form probes unless nothing named fits, and all of it for a complete model.
    """
    thresholds = thresholds or Thresholds()
    say = progress or (lambda done, what: None)
    parts = capture_roles(captures)
    say(0.0, "comparing the model with held-out captures")
    model = with_gains(captures, model, parts.fitted)
    before = evaluate_captures(captures, parts.held_out, model)
    ideal_excess = (ideal or (before if not model.present else ideal_errors(parts, model))).excess
    complete = thresholds.complete(before.excess, ideal_excess)

    if complete and not with_probes:
        return Diagnosis(model, before, ideal_excess, "complete", None, (), (), (), thresholds)

    candidates = [e for e in known.values() if e.name not in model.names]
    screened = screen_all(parts, model, candidates, pool, say)
    order = sorted(screened, key=lambda s: -s.removed_excess)
    promising = [
        s for s in order[:FIRST_TRIED] if s.removed_excess > 0.05 * max(order[0].removed_excess, 1e-12)
    ] or order[:1]
    # The screen says little of an effect whose derivatives do not reach, or that shows from capture to capture only.
    blind = [s for s in order if known[s.effect].rugged or known[s.effect].measure]
    first = promising + [s for s in blind if s not in promising]
    tried = try_all(parts, model, before, first[:2] if complete else first, pool, say, 0.3, 0.6)
    ranking = rank(before, tried, known, thresholds, ideal_excess, len(candidates))
    if not complete and not any(r.worth for r in ranking):
        rest = [s for s in order if s.effect not in {t.effect for t in tried}]
        tried += try_all(parts, model, before, rest, pool, say, 0.5, 0.7)
        ranking = rank(before, tried, known, thresholds, ideal_excess, len(candidates))
        if model.present and not any(r.worth for r in ranking):
            say(0.7, "fitting candidates and present effects together")
            settled, together = try_together_with_present(parts, model, tried, pool)
            jointly = rank(settled, together, known, thresholds, ideal_excess, len(candidates))
            ranking = jointly + [r for r in ranking if r.effect.name not in {t.effect for t in together}]
    verdict = verdict_of(complete, bool(ranking) and ranking[0].worth)

    probes: list[ProbeResult] = []
    if with_probes or verdict == "outside_catalogue":
        probes = probe_all(parts, model, before, pool, say)
    stage = None
    if verdict == "missing":
        stage = ranking[0].effect.stage
    elif verdict == "outside_catalogue":
        # A probe of a few thousand numbers that removes nothing on held-out captures points nowhere.
        telling = [p for p in probes if thresholds.worth_adding(p.removed, ideal_excess, len(probes))]
        stage = max(telling, key=lambda p: p.removed.value).stage if telling else None
    suggestions = suggest(parts, verdict, ranking)
    say(1.0, "done")
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
    )


def screen_all(
    parts: CaptureRoles, model: Model, effects: Sequence[Effect], pool: Pool, say: Progress
) -> list[ScreenResult]:
    """Screen every effect, dealt out among the pool's workers."""
    hands = min(pool.workers, len(effects)) or 1
    ids = tuple(c.capture for c in parts.screened)
    tasks = [(parts.folder, ids, model, tuple(effects[k::hands])) for k in range(hands)]
    say(0.05, f"screening {len(effects)} effects")
    dealt = pool.map(
        screen, tasks, lambda n: say(0.05 + 0.25 * n / hands, f"screening {len(effects)} effects")
    )
    return [s for hand in dealt for s in hand]


def try_all(
    parts: CaptureRoles,
    model: Model,
    before: PredictionErrors,
    screened: Sequence[ScreenResult],
    pool: Pool,
    say: Progress,
    start: float,
    end: float,
) -> list[CandidateFit]:
    """Fit candidates at their lowest order, then raise the order of those that do about as well as the best."""
    ids = tuple(c.capture for c in parts.fitted)
    held = tuple(c.capture for c in parts.held_out)

    def told(n: int) -> None:
        say(start + (end - start) * n / max(1, len(screened)), "fitting candidates")

    tasks = [(parts.folder, ids, held, model, s.start, False) for s in screened]
    tried = pool.map(try_effect, tasks, told)
    if not tried:
        return []
    least, most = min(t.held_out.excess for t in tried), before.excess
    again = [
        k
        for k, t in enumerate(tried)
        if len(t.model.instance(t.effect).effect.orders) > 1
        and most - t.held_out.excess > 0.3 * (most - least)
    ]
    tasks = [
        (
            parts.folder,
            ids,
            held,
            _without_gain_of(tried[k].model, model),
            tried[k].model.instance(tried[k].effect),
            True,
        )
        for k in again
    ]
    for k, better in zip(
        again, pool.map(try_effect, tasks, lambda n: say(end, "raising orders")), strict=True
    ):
        tried[k] = better
    return tried


def try_together_with_present(
    parts: CaptureRoles, model: Model, tried: Sequence[CandidateFit], pool: Pool
) -> tuple[PredictionErrors, list[CandidateFit]]:
    """The candidates that came closest, with the present effects fitted beside them, and the errors without any.

    An effect that was added alone may have taken up a part of one that is still missing, and stands in its way.
    """
    ids = tuple(c.capture for c in parts.fitted)
    held = tuple(c.capture for c in parts.held_out)
    nearest = sorted(tried, key=lambda t: t.held_out.excess)[:TRIED_TOGETHER]
    tasks = [(parts.folder, ids, held, model, "")]
    tasks += [(parts.folder, ids, held, t.model, t.effect) for t in nearest]
    without, *together = pool.map(try_together, tasks)
    return without.held_out, together


def _without_gain_of(fitted: Model, model: Model) -> Model:
    """The model before the candidate, with the gains that went with it."""
    return replace(model, gain=fitted.gain)


def rank(
    before: PredictionErrors,
    tried: Sequence[CandidateFit],
    known: Catalogue,
    thresholds: Thresholds,
    ideal_excess: float,
    candidates: int,
) -> list[RankedEffect]:
    """Candidates by excess removed, each with those that the captures cannot tell it from."""
    complete = thresholds.complete(before.excess, ideal_excess)
    ordered = sorted(tried, key=lambda t: t.held_out.excess)
    ranked = []
    for one in ordered:
        removed = removed_excess(before, one.held_out)
        worth = not complete and thresholds.worth_adding(removed, ideal_excess, candidates)
        alike = tuple(
            other.effect
            for other in ordered
            if other is not one
            and worth
            and _inseparable(one, other, before, thresholds, ideal_excess, candidates)
        )
        ranked.append(RankedEffect(known[one.effect], one.model, one.held_out, removed, worth, alike))
    return ranked


def _inseparable(
    one: CandidateFit,
    other: CandidateFit,
    before: PredictionErrors,
    thresholds: Thresholds,
    ideal_excess: float,
    candidates: int,
) -> bool:
    if not thresholds.worth_adding(removed_excess(before, other.held_out), ideal_excess, candidates):
        return False
    worse, better = (one, other) if one.held_out.excess > other.held_out.excess else (other, one)
    return thresholds.inseparable(removed_excess(worse.held_out, better.held_out), better.held_out.excess)


def probe_all(
    parts: CaptureRoles, model: Model, before: PredictionErrors, pool: Pool, say: Progress
) -> list[ProbeResult]:
    """Fit each stage's free-form probe alone."""
    ids = tuple(c.capture for c in parts.probed)
    held = tuple(c.capture for c in parts.held_out)
    tasks = [(parts.folder, ids, held, model, stage) for stage in STAGES]
    say(0.7, "probing the stages")
    found = pool.map(probe, tasks, lambda n: say(0.7 + 0.25 * n / len(tasks), "probing the stages"))
    return [ProbeResult.judged(p, before) for p in found]


def suggest(parts: CaptureRoles, verdict: str, ranking: Sequence[RankedEffect]) -> list[str]:
    """Captures that would tell more, most telling first."""
    suggestions: list[str] = []
    if verdict == "missing" and ranking[0].indistinguishable_from:
        alike = {r.effect.name: r.model for r in ranking}
        for other in ranking[0].indistinguishable_from:
            suggestions += captures_that_separate(
                parts, (ranking[0].effect.name, ranking[0].model), (other, alike[other])
            )
    patterns = [c.pattern for c in parts.captures.captures]
    if len(set(patterns)) == len(patterns):
        suggestions.append(
            "one pattern captured twice: without a repeat the camera's noise is taken on trust"
        )
    return list(dict.fromkeys(suggestions))
