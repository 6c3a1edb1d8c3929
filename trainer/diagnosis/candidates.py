"""Trying effects on a model: a quick screen of all, and real fits of some. Each is a task that any process can run.

The screen is a score test: how much of the residual lies in the span of the effect's derivative at "absent" (or at
the best of its starting points, where the derivative at absent does not reach), with the gains and the parameters of
all present effects projected out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from runtime.excess import PredictionErrors
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, chosen, opened
from trainer.fitting.gauss_newton import FitResult
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import fit_from, least_for_order, raise_order, settled
from trainer.model.model import EffectInstance, Model


@dataclass(frozen=True)
class CandidateFit:
    """A fitted candidate: the model with it, and its held-out errors."""

    effect: str
    model: Model
    fitted_excess: float
    held_out: PredictionErrors


def try_effect(
    folder: Path,
    ids: tuple[str, ...],
    held_ids: tuple[str, ...],
    model: Model,
    start: EffectInstance,
    raising: bool,
    iterations: int = 8,
) -> CandidateFit:
    """Fit one effect, with present ones as they are, and judge it on held-out captures."""
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    name = start.effect.name
    fitted = fit_from(model, start, batches, iterations)
    if raising:
        fitted = raise_order(fitted, name, batches, least_for_order)
    return _judged(name, fitted, captures, held_ids)


def try_together(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, name: str
) -> CandidateFit:
    """Fit all effects of a model together, and judge it on held-out captures as an explanation by effect `name`."""
    captures = opened(folder)
    return _judged(name, settled(model, load(captures, chosen(captures, ids))), captures, held_ids)


def _judged(name: str, fitted: FitResult, captures: CaptureSet, held_ids: tuple[str, ...]) -> CandidateFit:
    held_out = evaluate_captures(captures, chosen(captures, held_ids), fitted.model)
    return CandidateFit(name, fitted.model, fitted.errors.excess, held_out)
