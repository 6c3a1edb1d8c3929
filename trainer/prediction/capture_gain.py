"""Brightness of each capture, measured from the capture itself."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from trainer.prediction.stages import Sensor

STEPS = 8  # of Gauss-Newton, of which a smooth response takes three or four
SOME = 4  # one of so many rows and columns says a capture's brightness nearly
APART = 0.01  # of the light: between the two brightnesses whose difference is the slope
MOST = 0.7  # that one step may change the logarithm of the brightness
SETTLED = 1e-5


def own_gain(sensor: Sensor, signal: Tensor, measured: tuple[Tensor, Tensor]) -> Tensor:
    """Factor on each capture's light with which its counts are nearest to the measured ones.

    Parameters
    ----------
    sensor : Sensor
        Its response is taken into account: where counts are not proportional to light, neither is the factor to counts.
    signal : Tensor [B, h, w], counts
        Of the camera with a straight response and without light that is added in every capture alike.
    measured : (Tensor, Tensor)
        Counts above black, and weight, [B, h, w].

    Returns
    -------
    Tensor [B, 1, 1]
    """
    observed, weight = measured
    if sensor.response is None:
        if (always := sensor.added_always) is not None:
            observed = observed - always
        return _sum(observed * signal * weight) / _sum(signal**2 * weight)

    own = torch.ones_like(signal[:, :1, :1])
    with torch.no_grad():  # some pixels say it nearly, and all of them the rest
        for some in (slice(None, None, SOME), slice(None)):
            for _ in range(STEPS):
                change = _step(sensor, own, signal, observed, weight, some)
                own = own * torch.exp(change)
                if float(change.abs().max()) < SETTLED:
                    break
    # The last step has the derivatives of the whole search, as the ones before have come to rest.
    return own * torch.exp(_step(sensor, own, signal, observed, weight)) if torch.is_grad_enabled() else own


def _step(
    sensor: Sensor, own: Tensor, signal: Tensor, observed: Tensor, weight: Tensor, some: slice = slice(None)
) -> Tensor:
    """Change of the logarithm of each capture's gain, from some of the pictures' rows and columns."""
    signal, observed, weight = (t[..., some, some] for t in (signal, observed, weight))
    terms = brightness_terms(lambda f: _counts(sensor, f * own * signal, some), observed, weight)
    return brightness_step(*terms)


def brightness_terms(
    counts_of: Callable[[float], Tensor], observed: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Sums over each picture from which a better brightness follows, where counts are not proportional to light.

    Parameters
    ----------
    counts_of : callable
        Counts [B, h, w] at so many times the light.
    observed, weight : Tensor [B, h, w]

    Returns
    -------
    (Tensor, Tensor), each [B, 1, 1]
        Of error times slope, and of the slope's square, over the logarithm of the light.
    """
    error = observed - counts_of(1)
    slope = (counts_of(1 + APART) - counts_of(1 - APART)) / (2 * APART)
    return _sum(error * slope * weight), _sum(slope**2 * weight)


def brightness_step(along: Tensor, power: Tensor) -> Tensor:
    """Change of the light's logarithm by Gauss-Newton, from sums as `brightness_terms` gives them."""
    return torch.clamp(along / torch.where(power > 0, power, torch.ones_like(power)), -MOST, MOST)


def _counts(sensor: Sensor, light: Tensor, some: slice) -> Tensor:
    counts = light if (always := sensor.added_always) is None else light + always[..., some, some]
    return sensor.responded(counts)


def _sum(values: Tensor) -> Tensor:
    return values.sum((-2, -1), keepdim=True)
