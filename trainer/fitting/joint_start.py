"""A start from far away: where several strong effects hide one another, they are fitted together, coarse to fine.

Speckle that is a pixel off says nothing, and no effect helps alone. What survives smoothing says where the picture is,
how bright it is from place to place, and where it is bent: so registration, beam, distance, wavefront and response are
fitted together to pictures that are smoothed less and less, and to fewer of them the more each one says.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from runtime.program.progress import Progress, no_progress
from trainer.captures.batches import Batch
from trainer.effects.effect_catalogue import Catalogue
from trainer.effects.evidence import Evidence
from trainer.effects.own_effect import starts_of
from trainer.fitting.dependence import dependence
from trainer.fitting.gauss_newton import HOLD, ROUGH, FitResult, fit, with_measured_values
from trainer.fitting.idle_effects import most_telling, without_idle
from trainer.fitting.jacobian import away_from_absent
from trainer.fitting.least_squares_gain import with_gain
from trainer.fitting.predictor import Predictor, lights_of, telling
from trainer.fitting.refit import least_for_order, raise_orders
from trainer.fitting.start_points import start_cost
from trainer.model.model import Model, absent, instance_with

TOGETHER = (
    "misregistration",
    "illumination",
    "panel_wavefront",
    "distance",
    "phase_response",
    "zero_order",
    "sensor_response",
)
# Where the panel is bent, only a leak that is flat tells curvature from distance and size. A leak of any shape would
# take up what the panel's own shape still lacks.
# A response costs little to be bent as it may be, and what it lacks others take up.
ORDERS = {"zero_order": 2, "sensor_response": 6}
# A moved camera does what a tilt does, and with another magnification a curvature does what a distance does.
TAKEN_FOR_EACH_OTHER = ("misregistration", "panel_wavefront", "distance")
TILTS = 2  # the first two terms of a wavefront
FIXED = (("zero_order", "leak_wavefront"),)
# smoothed pictures say nothing of them; next to them, pictures as they are hardly fit
FINE = ("sensor_blur", "crosstalk", "vignetting")
AT_LAST = ("laser_drift",)  # while pictures do not fit, a gain for each only takes up what is wrong
SMOOTHING_PX = (8.0, 4.0, 2.0, 1.0)
# Pictures that are smoothed by so much tell no tilt from a shift, and say little of higher orders. Finer ones do not
# fit without these.
COARSE_PX = 4.0
# Excess from which smoothed pictures may lack orders, and the share of it that these must remove.
LACKING, RAISED = 0.05, 0.3
ITERATIONS, TOLERANCE = 6, 0.05
# With less, magnification, distance and curvature run away together: pictures smoothed by 4 pixels hardly tell them.
HOLD_SMOOTHED = 0.03
# Excess below which it shows which effects do nothing of their own. When these are first left out, orders are raised
# until less than NEARER is left, and then each time as far as that pays: the others may need them now.
NEAR, NEARER = 0.01, 0.002
NUMBERS = 1000  # independent ones that the pictures should hold, smoothed as they are


def joint_start(
    model: Model,
    known: Catalogue,
    batches: Sequence[Batch],
    least: float,
    progress: Progress | None = None,
) -> Model:
    """The model with the effects that most benches have, fitted together from coarse to fine, their orders raised.

    Without those that then do nothing of their own.

    Parameters
    ----------
    known : Catalogue
        Effects of TOGETHER, FINE and AT_LAST that it lacks are left out.
    least : float
        Excess that makes no difference.
    progress : callable, optional
        Called with the share that is done and what is being done.

    Returns
    -------
    Model
        Fitted to a few of the captures.
    """
    report = progress or no_progress
    names, fine, late = (
        [n for n in some if n in known and n not in model.names] for some in (TOGETHER, FINE, AT_LAST)
    )
    for name in names:
        model = model.having(absent(known[name], model.bench, ORDERS.get(name)))
    coarse = _smoothed(model, batches, SMOOTHING_PX[0])
    for name in names:
        model = _best_start(model, name, coarse)
    for k, sigma in enumerate(SMOOTHING_PX):
        report(
            k / (len(SMOOTHING_PX) + 1),
            f"fitting {len(names)} effects together, smoothed by {sigma:g} pixels",
        )
        model = _fitted_to_smoothed(model, batches, sigma)
    report(len(SMOOTHING_PX) / (len(SMOOTHING_PX) + 1), f"fitting {len(names + fine)} effects together")
    for name in fine:
        model = model.having(absent(known[name], model.bench))
    fitted = _with_orders_raised(model, batches, NEAR)
    enough, next_one = math.inf, NEARER
    # Farther away, what is idle may do something when the others are right.
    while fitted.errors.excess < NEAR:
        smaller = without_idle(fitted.model, batches, least)
        if smaller is fitted.model and enough == 0:
            break
        enough, next_one = next_one, 0.0
        fitted = _with_orders_raised(smaller, batches, enough)
    model = fitted.model
    for name in late:
        model = with_measured_values(model.having(absent(known[name], model.bench)), [name], batches)
    return model


def without_effect(model: Model, name: str, known: Catalogue, batches: Sequence[Batch]) -> Model:
    """The model without an effect of TAKEN_FOR_EACH_OTHER, and with the others of these, which do its work.

    What it did may be another one's, and a joint start may end with some of both. Those take over what a straight line
    says, and are fitted to smoothed pictures again: fitted to pictures as they are, they do not find back.

    Parameters
    ----------
    known : Catalogue
        Has the effects that the model lacks.
    """
    for other in TAKEN_FOR_EACH_OTHER:
        if other not in model.names and other in known:
            model = model.having(absent(known[other], model.bench))
    model = dependence(model, most_telling(model, batches)).without([name])
    for sigma in SMOOTHING_PX:
        if sigma < COARSE_PX:
            model = _fitted_to_smoothed(model, batches, sigma)
    model = _with_orders_raised(model, batches).model
    return fit(model, model.names, batches, tolerance=ROUGH).model


def _shifted_not_tilted(model: Model, batches: Sequence[Batch]) -> Model:
    """The model without a tilt of its wavefront, whose work a moved camera does.

    Smoothed pictures hardly tell the two apart, and fitted to pictures as they are, some of each does not become one.
    """
    tilts = [("panel_wavefront", "wavefront", k) for k in range(TILTS)]
    both = {"misregistration", "panel_wavefront"} <= set(model.names)
    if not both or not any(away_from_absent(model, tilt) for tilt in tilts):
        return model
    return dependence(model, batches).without_numbers(tilts)


def _fitted_to_smoothed(model: Model, batches: Sequence[Batch], sigma_px: float) -> Model:
    """The model with all of its effects fitted to smoothed pictures, their orders raised where these need it."""
    smoothed = _smoothed(model, batches, sigma_px)
    model = _shifted_not_tilted(model, smoothed)
    fitted = fit(model, model.names, smoothed, ITERATIONS, TOLERANCE, None, HOLD_SMOOTHED, FIXED)

    def needed(excess: float) -> float:
        return math.inf if sigma_px >= COARSE_PX or excess < LACKING else RAISED * excess

    return raise_orders(fitted, model.names, smoothed, needed, HOLD_SMOOTHED, FIXED).model


def _with_orders_raised(model: Model, batches: Sequence[Batch], enough: float = 0.0) -> FitResult:
    """The model with all of its effects fitted to a few pictures as they are, orders raised until that is enough."""
    few = [_some(model, b, 0.0) for b in batches]
    model = _shifted_not_tilted(model, few)
    fitted = fit(model, model.names, few, ITERATIONS, TOLERANCE, None, HOLD, FIXED)

    def needed(excess: float) -> float:
        return math.inf if excess < enough else least_for_order(excess)

    return raise_orders(fitted, model.names, few, needed, HOLD, FIXED)


def _smoothed(model: Model, batches: Sequence[Batch], sigma_px: float) -> list[Batch]:
    return [_some(model, b, sigma_px).smoothed(sigma_px) for b in batches]


def _some(model: Model, batch: Batch, sigma_px: float) -> Batch:
    """So many of a batch's captures, those of which the model leaves most unexplained, that they say NUMBERS."""
    spot = max(1.0, 4 * math.pi * sigma_px**2)  # pixels of a Gaussian's square
    count = math.ceil(NUMBERS * spot / batch.signal[0].numel())
    return telling(model, batch, count)


@torch.no_grad()
def _best_start(model: Model, name: str, batches: Sequence[Batch]) -> Model:
    """The model with an absent effect at the best of the starts that its own look at the captures gives."""
    effect = model.instance(name).effect
    if effect.starts is None:
        return model
    predictors = [Predictor(model, b) for b in batches]
    points = [p.trace(model) for p in predictors]
    lights = lights_of(model, predictors, points)
    model = with_gain(model, predictors, lights)
    evidence = [
        Evidence(p.scene, p.batch, p.counts(model, light))
        for p, light in zip(predictors, lights, strict=True)
    ]
    starts = [model.instance(name)]
    starts += [instance_with(effect, model.bench, values) for values in starts_of(effect, evidence)]
    return model.having(min(starts, key=lambda s: start_cost(model, predictors, points, s)))
