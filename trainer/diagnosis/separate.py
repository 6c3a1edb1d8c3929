"""Which captures would tell two explanations apart: where their predictions differ most."""

from __future__ import annotations

from dataclasses import replace

import torch

from firmware_iface.errors import InputError
from trainer.captures.batches import Batch, load_batch
from trainer.captures.held_out import CaptureRoles
from trainer.effects.own_effect import OwnEffectError
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model

PLANES = (0.6, 1.6)  # other planes proposed, as shares of the distance


def captures_that_separate(
    roles: CaptureRoles, one: tuple[str, Model], other: tuple[str, Model]
) -> list[str]:
    """Captures that would separate two explanations.

    For each proposal both models predict the same patterns; what counts is the squared difference, with the gain
    left free, over the variance of the signal.

    Parameters
    ----------
    one, other : tuple of str and Model
        Name and model of each explanation.

    Returns
    -------
    list of str
        Sentences, the best capture first; empty where no proposal is better than the captures that there are.
    """
    row = roles.fitted[0]
    batch = load_batch(roles.captures, [row])
    here = _difference(one[1], other[1], batch)
    channels = [c.name for c in roles.captures.bench.channels]
    proposals = [
        (f"the same patterns at {row.plane_mm * f:.3g} mm", replace(batch, plane_mm=row.plane_mm * f))
        for f in PLANES
    ]
    unused = [c for c in channels if c not in roles.captures.channels]
    proposals += [(f"the same patterns in {c}", replace(batch, channel=c)) for c in unused]
    found = []
    for words, moved in proposals:
        try:
            there = _difference(one[1], other[1], moved)
        except OwnEffectError:
            raise
        except InputError:  # the sampling does not reach this plane
            continue
        if there > max(3 * here, 1e-4):
            found.append((there, words))
    found.sort(reverse=True)
    return [
        f"{words}: {one[0]} and {other[0]} differ there by {100 * there**0.5:.1f} % of the signal's rms"
        for there, words in found
    ]


def with_all_gains(model: Model, channel: str) -> Model:
    """The model with a gain for a colour that was not captured yet: that of another."""
    return replace(model, gain={channel: next(iter(model.gain.values())), **model.gain})


def _difference(one: Model, other: Model, batch: Batch) -> float:
    """Squared difference of two models' predictions of a batch, gain left free, over the signal's variance."""
    with torch.no_grad():
        predictions = []
        for model in (one, other):
            model = with_all_gains(model, batch.channel)
            predictor = Predictor(model, batch)
            predictions.append(predictor.predict(model))
        a, b = predictions
        b = b * (a * b).sum() / (b * b).sum()
        return float(((a - b) ** 2).mean() / a.var())
