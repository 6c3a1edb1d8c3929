"""What a capture would say: of a model's numbers, and of what tells it from its rivals.

For a capture with predicted counts y, noise of variance v in each pixel and slopes J, a fit of squared counts gives the
numbers the covariance (J'J)^-1 J'VJ (J'J)^-1: noisy pixels weigh as much as others, so a longer exposure is not always
better. J'J and J'VJ of several captures add up.

A rival's prediction differs from the model's by d. The information on the share t of the rival in model + t d,
J' V^-1 J with the rival's own numbers left free, is what the captures say of the choice between the two: a rival that
could imitate the model by other numbers gains nothing. It adds up, too.

References
----------
Atkinson and Fedorov 1975.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from trainer.captures.batches import EARLIER, Batch, in_view, load_batch
from trainer.captures.camera_noise import noise_variance
from trainer.captures.capture_set import CaptureSet, chosen, opened
from trainer.captures.possible_captures import PossibleCapture
from trainer.device import array_of
from trainer.diagnosis.separate import with_all_gains
from trainer.effects.own_effect import OwnEffectError
from trainer.fitting.jacobian import columns, keys_of
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model
from trainer.prediction.camera_light import counts

PIXELS = 30_000  # of a picture that are looked at, spread at random; what they say stands for all
KNOWN_SCALES = 20.0  # scales of a number within which it is known before any capture
KNOWN_GAIN = 1.0  # the same for the logarithm of a gain
MOST_SATURATED = 0.02  # of the pixels; a capture with more is no candidate: `check` would find fault with it
CLEAR = 3.0  # standard deviations of noise that a pixel stays below the top count

Array = np.ndarray


@dataclass(frozen=True)
class ExpectedInformation:
    """What one capture would say.

    Attributes
    ----------
    normal, scatter : array [n, n]
        J'J and J'VJ of the model's numbers in units of their scales, then of the logarithms of the gains; counts in
        units of the noise at half of full scale.
    rivals : tuple of arrays [m, m]
        For each rival: the information on the rival's numbers and the gains, and last on its share t.
    difference : tuple of float
        For each rival: squared difference of the predictions, gain left free, over the variance of the signal.
    excess : array [n, n]
        Excess for errors of the numbers: e' excess e.
    saturated : float
        Share of the pixels.
    """

    normal: Array
    scatter: Array
    rivals: tuple[Array, ...]
    difference: tuple[float, ...]
    excess: Array
    saturated: float


def covariance(normal: Array, scatter: Array) -> Array:
    """Of the numbers that a fit of squared counts finds."""
    inverse = np.linalg.inv(normal)
    return np.asarray(inverse @ scatter @ inverse)


def prior(model: Model) -> Array:
    """Information before any capture: numbers within KNOWN_SCALES of their scales, gains within KNOWN_GAIN."""
    numbers, gains = len(keys_of(model, model.names)), len(model.bench.channels)
    return np.diag([KNOWN_SCALES**-2.0] * numbers + [KNOWN_GAIN**-2.0] * gains)


def information_of_captures(
    folder: Path, ids: tuple[str, ...], model: Model, rivals: tuple[Model, ...], unexplained: float
) -> list[ExpectedInformation]:
    """What captures of a set say.

    Parameters
    ----------
    unexplained : float
        Excess that the model leaves, which counts as noise.
    """
    captures = opened(folder)
    found = []
    with torch.no_grad():
        for row in chosen(captures, ids):
            found += _information(load_batch(captures, [row]), model, rivals, unexplained)
    return found


def information_of_possible(
    folder: Path, one: PossibleCapture, model: Model, rivals: tuple[Model, ...], unexplained: float
) -> list[ExpectedInformation]:
    """What a possible capture would say at each of its exposures; nothing where the model does not reach its plane."""
    captures = opened(folder)
    last = [captures.gray(c) for c in captures.captures[: -EARLIER - 1 : -1]]
    earlier = np.stack([last[min(k, len(last) - 1)] for k in range(EARLIER)]).astype(np.int32)
    with torch.no_grad():
        try:
            batch = _imagined(one, model, captures, torch.as_tensor(earlier))
            return _information(batch, model, rivals, unexplained)
        except OwnEffectError:
            raise
        except InputError:  # the sampling does not reach this plane
            return []


def _imagined(one: PossibleCapture, model: Model, captures: CaptureSet, earlier: Tensor) -> Batch:
    """The captures of one pattern at several exposures as the model predicts them: [1, H, W] gray, [B, h, w] counts."""
    model, camera = with_all_gains(model, one.channel), captures.noise_camera()
    exposure = torch.tensor(one.exposures_ms, dtype=torch.float32)
    nothing = torch.zeros((len(exposure), *camera.shape))
    batch = Batch(
        one.channel,
        one.plane_mm,
        tuple(f"{e:g} ms" for e in one.exposures_ms),
        torch.as_tensor(one.gray.astype(np.int32))[None],
        nothing,
        nothing,
        nothing,
        exposure,
        captures.usual_exposure_ms(one.channel),
        functools.cache(lambda: earlier[None]),
    )
    predictor = Predictor(model, batch)
    light = predictor.light(model, predictor.trace(model))
    signal = counts(predictor.scene, predictor.stages(model), light, predictor.gain(model), None)
    noise = torch.as_tensor(noise_variance(array_of(signal), camera), dtype=torch.float32)
    mask = (signal + CLEAR * noise.sqrt() < camera.full_scale).to(torch.float32)
    view = in_view(model.bench)
    if view is not None:
        mask = mask * torch.as_tensor(view, dtype=torch.float32)
    return replace(batch, signal=signal, mask=mask, noise=noise)


def _information(
    batch: Batch, model: Model, rivals: tuple[Model, ...], unexplained: float
) -> list[ExpectedInformation]:
    """Information of each capture of a batch."""
    model = with_all_gains(model, batch.channel)
    base, slopes = _slopes(model, batch)
    others = [_slopes(with_all_gains(r, batch.channel), batch) for r in rivals]
    camera = model.bench.camera
    unit = float(noise_variance(np.array(camera.full_scale / 2), camera))
    size = batch.mask[0].numel()
    which = np.random.default_rng(0).permutation(size)[:PIXELS]
    share = len(which) / size
    view = in_view(model.bench)
    seen = size if view is None else int(view.sum())
    found = []
    for k in range(len(batch.exposure)):
        mask = _pixels(batch.mask[k], which)
        signal, count = _pixels(base[k], which), max(float(mask.sum()), 1.0)
        mean = float((mask * signal).sum()) / count
        variance = float((mask * (signal - mean) ** 2).sum())
        noise = _pixels(batch.noise[k], which) + max(unexplained, 0.0) * variance / count
        weight = mask / noise / share
        rows = [_pixels(s[k], which) for s in slopes]
        pairs, difference = [], []
        for other, there in others:
            off = signal - _pixels(other[k], which)
            pairs.append(_normal([*(_pixels(s[k], which) for s in there), off], weight))
            along = float((mask * off * signal).sum()) / max(float((mask * signal**2).sum()), 1e-30)
            left = float((mask * (off - along * signal) ** 2).sum())
            difference.append(left / max(variance, 1e-30))
        found.append(
            ExpectedInformation(
                _normal(rows, mask / unit / share),
                _normal(rows, mask * noise / unit**2 / share),
                tuple(pairs),
                tuple(difference),
                _normal(rows, mask) / max(variance, 1e-30),
                1 - float(batch.mask[k].sum()) / seen,
            )
        )
    return found


def _slopes(model: Model, batch: Batch) -> tuple[Tensor, list[Tensor]]:
    """Prediction, and its slopes: a scale of each number, then the logarithms of all colours' gains."""
    predictor = Predictor(model, batch)
    keys = keys_of(model, model.names)
    base, found = columns(model, keys, predictor, predictor.trace(model))
    scaled = [
        s * model.instance(k[0]).effect.parameter(k[1]).scale for k, s in zip(keys, found, strict=False)
    ]
    own = predictor.scene.channel_row()
    gains = [found[-1] if k == own else torch.zeros_like(base) for k in range(len(model.bench.channels))]
    return base, scaled + gains


def _pixels(picture: Tensor, which: Array) -> Array:
    return array_of(picture.reshape(-1).double())[which]


def _normal(rows: Sequence[Array], weight: Array) -> Array:
    stack = np.stack(rows)
    return np.asarray((stack * weight) @ stack.T)
