"""What a capture set leaves in doubt: the best explanation, and the rivals that do as well in its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.program.progress import Progress, no_progress, part_of
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import sample, split
from trainer.diagnosis.bench_facts import EqualFacts
from trainer.diagnosis.diagnosis import Diagnosis, diagnose
from trainer.diagnosis.ranking import RankedEffect
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import Pool
from trainer.model.model import Model, instance_with

LIKELY = 2  # candidates that are taken for rivals where none is worth adding


@dataclass(frozen=True)
class Rival:
    """An explanation that does as well as the best one.

    Attributes
    ----------
    of, name : str
        The effect of the best explanation that is in doubt ("" for the model as it is), and the one in its place.
    model : Model
        With the rival fitted in it.
    """

    of: str
    name: str
    model: Model

    def __str__(self) -> str:
        return f"{self.of or 'the present model'} from {self.name}"


@dataclass(frozen=True)
class Doubts:
    """What captures leave in doubt.

    Attributes
    ----------
    diagnosis : Diagnosis
        Of the present model, its effects fitted to the captures.
    model : Model
        The best explanation: with the effect that is missing, or with one exchanged that another one beats. All
        of its effects are fitted together.
    rivals : tuple of Rival
        Empty where the captures decide.
    fitted : tuple of Capture
        What `model` was fitted to.
    """

    diagnosis: Diagnosis
    model: Model
    rivals: tuple[Rival, ...]
    fitted: tuple[Capture, ...]

    @property
    def unexplained(self) -> float:
        """Excess that the best explanation leaves."""
        found = self.diagnosis
        left = found.ranking[0].held_out if found.verdict == "missing" else found.held_out
        return max(left.excess, 0.0)

    @property
    def decided(self) -> bool:
        """Whether the captures say what is missing, or that nothing is."""
        found = self.diagnosis
        return found.verdict != "outside_catalogue" and not self.rivals and found.is_held_out


def doubts_of(
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
) -> Doubts:
    """What a capture set leaves in doubt of a model and of what it lacks.

    The model's effects are fitted to the captures, and it is diagnosed. Of a model that lacks nothing, each effect is
    taken out and looked for again, because others may do as well in its place.

    Parameters
    ----------
    progress : callable, optional
        Called with the share that is done and what is being done.
    """
    report = progress or no_progress
    rows = fit_rows(captures)
    batches = load(captures, rows)
    if model.present:
        report(0.0, "fitting the model to the captures")
        model = fit(model, model.names, batches).model
    parts = 1 + len(model.names)
    found = diagnose(
        captures, model, known, pool, thresholds, part_of(report, 0.05, 1 / parts), thorough=False
    )
    rivals: list[Rival] = []
    best = found.model
    if found.verdict == "missing":
        best = found.ranking[0].model
        rivals = _rivals(found.ranking[0].effect.name, found.ranking)
    elif found.verdict == "complete":
        for k, name in enumerate(best.names, 1):
            part = part_of(report, k / parts, (k + 1) / parts, f"without {name}")
            again = diagnose(captures, best.without(name), known, pool, thresholds, part, thorough=False)
            best, more = _exchanged(best, name, again.ranking)
            rivals += more
    else:  # what is most like what is missing shows which captures say most of it
        likely = [r for r in found.ranking if r.removed.value > 0][:LIKELY]
        rivals = [Rival("", r.effect.name, r.model) for r in likely]
    rivals += _equal_wavelength(best, known, found.equal_facts, captures)
    report(1.0, "fitting the best explanation")
    if best.present:
        best = fit(best, best.names, batches).model
    return Doubts(found, best, tuple(rivals), tuple(rows))


def fit_rows(captures: CaptureSet) -> list[Capture]:
    """Captures that parameters are fitted to: of small pictures all that are not held out."""
    rows = split(captures).fitted
    height, width = captures.bench.panel.shape
    return sample(rows, height * width, len(rows))


def _rivals(name: str, ranking: Sequence[RankedEffect]) -> list[Rival]:
    """The effects of a ranking that its first one cannot be told from."""
    alike = ranking[0].indistinguishable_from
    return [Rival(name, r.effect.name, r.model) for r in ranking if r.effect.name in alike]


def _exchanged(model: Model, name: str, ranking: Sequence[RankedEffect]) -> tuple[Model, list[Rival]]:
    """The model with an effect exchanged for one that clearly does better in its place, and the rivals of either.

    Parameters
    ----------
    ranking : sequence of RankedEffect
        Of the model without the effect.
    """
    if not ranking or not ranking[0].worth_adding:
        return model, []
    first = ranking[0]
    alike = {first.effect.name, *first.indistinguishable_from}
    if name not in alike:
        return first.model, _rivals(first.effect.name, ranking)
    return model, [Rival(name, r.effect.name, r.model) for r in ranking if r.effect.name in alike - {name}]


def _equal_wavelength(model: Model, known: Catalogue, equal: EqualFacts, captures: CaptureSet) -> list[Rival]:
    """The wavelength that would explain captures of one plane as well as the model's distance does."""
    if equal.effect != "distance" or "wavelength" not in known or "wavelength" in model.names:
        return []
    if "distance" not in model.names or not any(f.fact == "channel.wavelength_nm" for f in equal.facts):
        return []
    ratio = 1 + float(model.instance("distance").values["offset"]) / captures.planes[0]
    offsets = (ratio - 1) * np.array([c.wavelength_nm for c in model.bench.channels])
    other = instance_with(known["wavelength"], model.bench, {"offset": offsets})
    return [Rival("distance", "wavelength", model.without("distance").having(other))]
