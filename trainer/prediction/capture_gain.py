"""Brightness of each capture, measured from the capture itself."""

from __future__ import annotations

import torch
from torch import Tensor

from trainer.prediction.stages import Sensor

STEPS = 8  # of Gauss-Newton, of which a smooth response takes three or four
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
        Of the camera without added light and with a straight response.
    measured : (Tensor, Tensor)
        Counts above black, and weight, [B, h, w].

    Returns
    -------
    Tensor [B, 1, 1]
    """
    observed, weight = measured
    if sensor.response is None:
        if sensor.offset is not None:
            observed = observed - sensor.offset
        return _sum(observed * signal * weight) / _sum(signal**2 * weight)
    own = torch.ones_like(signal[:, :1, :1])
    with torch.no_grad():
        for _ in range(STEPS):
            step = _step(sensor, own * signal, observed, weight)
            own = own * torch.exp(step)
            if float(step.abs().max()) < SETTLED:
                break
    # The last step has the derivatives of the whole search, as the ones before have come to rest.
    return own * torch.exp(_step(sensor, own * signal, observed, weight)) if torch.is_grad_enabled() else own


def _step(sensor: Sensor, light: Tensor, observed: Tensor, weight: Tensor) -> Tensor:
    """Change of the brightness's logarithm that fits the counts better, [B, 1, 1]."""
    error = observed - _counts(sensor, light)
    slope = (_counts(sensor, (1 + APART) * light) - _counts(sensor, (1 - APART) * light)) / (2 * APART)
    power = _sum(slope**2 * weight)
    step = _sum(error * slope * weight) / torch.where(power > 0, power, torch.ones_like(power))
    return torch.clamp(step, -MOST, MOST)


def _counts(sensor: Sensor, light: Tensor) -> Tensor:
    assert sensor.response is not None
    counts = light if sensor.offset is None else light + sensor.offset
    return sensor.response(counts / sensor.full_scale) * sensor.full_scale


def _sum(values: Tensor) -> Tensor:
    return values.sum((-2, -1), keepdim=True)
