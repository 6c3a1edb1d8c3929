"""A model's effects fitted again to a headset's captures, without looking for new ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

from runtime.excess import PredictionErrors
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import FIT_CAPTURES, capture_roles, with_stopping
from trainer.diagnosis.diagnosis import ideal_errors
from trainer.diagnosis.verdict import Thresholds, below_the_noise, noise_floor
from trainer.fitting.free_form_effects import refined
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pixel_values import pixel_noise, with_pixel_values
from trainer.fitting.predictor import evaluate_captures
from trainer.fitting.refit import fit_from
from trainer.model.model import Model


@dataclass(frozen=True)
class Recalibration:
    """A model before and after it was fitted again.

    Attributes
    ----------
    model : Model
        With the fitted values.
    before, after : PredictionErrors
        On the held-out captures; before: with the model's values, and gains of these captures.
    complete : bool
        Whether what remains is too little to explain.
    """

    model: Model
    before: PredictionErrors
    after: PredictionErrors
    complete: bool


def recalibrate(captures: CaptureSet, model: Model, thresholds: Thresholds | None = None) -> Recalibration:
    """Fit a model's effects and gains to captures; effects, orders and learned fields stay as they are.

    Parameters
    ----------
    model : Model
        Of the same kind of bench.
    """
    roles = capture_roles(captures)
    # Laser power and exposure differ from headset to headset, and are no effects.
    model = with_gains(captures, replace(model, gain={}), roles.fitted)
    before = evaluate_captures(captures, roles.held_out, model)
    batches = load(captures, roles.fitted)
    fitted = model
    for name in model.names:
        if model.instance(name).effect.rugged:  # derivatives do not reach as far as headsets differ
            fitted = fit_from(fitted, fitted.instance(name), batches).model
    fitted = fit(fitted, fitted.names, batches).model
    if any(p.nodes is not None for p in fitted.present):
        first, last = with_stopping(roles.probed, FIT_CAPTURES)
        fitted = refined(fitted, load(captures, first), load(captures, last))
    fitted = with_pixel_values(captures, fitted)
    after = evaluate_captures(captures, roles.held_out, fitted)
    limits = replace(
        thresholds or Thresholds(),
        floor=noise_floor(captures, after),
        pixel_noise=pixel_noise(captures, fitted),
    )
    ideal = ideal_errors(roles, fitted).excess
    complete = limits.complete(after.excess, ideal) and not below_the_noise(after)
    return Recalibration(fitted, before, after, complete)
