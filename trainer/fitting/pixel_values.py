"""Values that each camera pixel has for itself: read off all captures that fits may see, with some of their noise."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from trainer.captures.batches import Batch, load, load_batch, signal_variance
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import split
from trainer.effects.definition import Effect
from trainer.fitting.gauss_newton import with_measured_values
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model

SOME_PIXELS = 50_000  # are enough for the spreads of the values
ROUNDS = 20


def is_by_pixel(effect: Effect) -> bool:
    """Whether each camera pixel has values of its own."""
    return any(p.per_pixel for p in effect.parameters)


def with_pixel_values(captures: CaptureSet, model: Model) -> Model:
    """The model with its values by pixel read off all captures that fits may see: the more, the less of their noise."""
    names = [p.effect.name for p in model.present if is_by_pixel(p.effect)]
    return with_measured_values(model, names, load(captures, _read_off(captures, model))) if names else model


@torch.no_grad()
def pixel_noise(captures: CaptureSet, model: Model) -> float:
    """Excess on held-out captures that comes of the noise in a model's values by pixel alone.

    A pixel's gain and offset are read off a dozen pictures, and keep a share of these pictures' noise. No other effect
    can explain what that does to other pictures; only more captures take it away. It is the variance of predictions of
    a linear model whose values are drawn from normal distributions about zero.

    Returns
    -------
    float
        0 for a model without such values, and where nothing is held out.

    References
    ----------
    Bishop 2006, Pattern Recognition and Machine Learning, equations 3.54 and 3.59.
    """
    values = [
        (present.effect.name, p.name)
        for present in model.present
        for p in present.effect.parameters
        if p.per_pixel
    ]
    roles = split(captures)
    if not values or not roles.is_held_out:
        return 0.0
    told = torch.zeros(1, dtype=torch.float64)
    for batch in load(captures, _read_off(captures, model)):
        slopes = _slopes(model, values, batch)
        told = told + torch.einsum("kbyx,lbyx,byx->yxkl", slopes, slopes, (batch.mask / batch.noise).double())
    found = torch.stack([torch.from_numpy(model.instance(e).values[p]).to(told) for e, p in values], dim=-1)
    scatter = torch.linalg.inv(told + _spreads(told, found).pow(-2).diag())
    held_out = load(captures, roles.held_out)
    left = 0.0
    for batch in held_out:
        slopes = _slopes(model, values, batch)
        left += float(torch.einsum("kbyx,yxkl,lbyx,byx->", slopes, scatter, slopes, batch.mask.double()))
    return left / signal_variance(held_out)


def _read_off(captures: CaptureSet, model: Model) -> list[Capture]:
    """The captures that fits may see; of a slow panel not the set's first: nobody knows what was shown before.

    Where there is no other, it is better than none.
    """
    first, *_ = captures.captures
    parts = Predictor(model, load_batch(captures, [first])).parts(model)
    slow = any(stages.drive.persistence is not None for _, stages in parts)
    fitted = list(split(captures).fitted)
    return [row for row in fitted if not slow or row.capture != first.capture] or fitted


def _slopes(model: Model, values: list[tuple[str, str]], batch: Batch) -> Tensor:
    """Derivatives of predicted counts with respect to each of the pixels' own values, [K, B, h, w].

    Neighbours move in opposite directions, so that what is measured of a whole picture, such as its gain, stays.
    """
    predictor = Predictor(model, batch)
    here = predictor.predict(model).double()
    height, width = here.shape[-2:]
    sign = (-1.0) ** (np.arange(height)[:, None] + np.arange(width))
    slopes = []
    for name, parameter in values:
        present = model.instance(name)
        step = present.effect.parameter(parameter).scale * sign
        moved = present.with_values({**present.values, parameter: present.values[parameter] + step})
        change = predictor.predict(model.having(moved)).double() - here
        slopes.append(change / torch.from_numpy(step).to(change))
    return torch.stack(slopes)


def _spreads(told: Tensor, found: Tensor) -> Tensor:
    """Standard deviations of the pixels' true values [K], from what captures tell [h, w, K, K] and values [h, w, K].

    By expectation maximisation (Dempster, Laird and Rubin 1977).
    """
    count = found.shape[-1]
    apart = max(1, found.numel() // count // SOME_PIXELS)
    told, found = told.reshape(-1, count, count)[::apart], found.reshape(-1, count)[::apart]
    spreads = found.std(0).clamp(min=1e-9)
    for _ in range(ROUNDS):
        variance = torch.linalg.inv(told + spreads.pow(-2).diag()).diagonal(dim1=-2, dim2=-1)
        spreads = (found**2 + variance).mean(0).sqrt()
    return spreads
