"""The displacement of each capture's picture, measured from the capture itself."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from trainer.prediction.stages import Sensor

STEPS = 3  # of Gauss-Newton; displacements are a small part of a speckle
MOST = 1.0  # panel pixels that one step may move


def displaced_spectrum(
    sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor], measured: tuple[Tensor, Tensor]
) -> Tensor:
    """The spectrum of pictures, each displaced to where its capture has it.

    Parameters
    ----------
    spectrum : complex Tensor [B, n, m]
        Of the pictures over the frequencies (iy, ix), before their displacement.
    read : callable
        Gives the light on the camera's pixels, [B, h, w], of such a spectrum.
    measured : (Tensor, Tensor)
        Signal and weight, [B, h, w].
    """
    with torch.no_grad():
        shift = torch.zeros((*spectrum.shape[:-2], 2), dtype=sensor.iy.dtype)
        plain = spectrum.detach()
        for _ in range(STEPS):
            shift = shift + _step(sensor, plain * _ramp(sensor, shift), read, measured)
    return spectrum * _ramp(sensor, shift)


def _ramp(sensor: Sensor, shift: Tensor) -> Tensor:
    """Transfer functions of displacements [B, 2], panel pixels: light of a place that much farther on."""
    angle = 2 * math.pi * (sensor.iy * shift[..., :1, None] + sensor.ix * shift[..., 1:, None])
    return torch.polar(torch.ones_like(angle), angle)


def _step(
    sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor], measured: tuple[Tensor, Tensor]
) -> Tensor:
    """Displacements [B, 2] that fit the pictures better, each with a brightness of its own."""
    observed, weight = measured
    if sensor.offset is not None:
        observed = observed - sensor.offset
    columns = [read(spectrum)]
    columns += [read(spectrum * (2j * math.pi * f)) for f in (sensor.iy, sensor.ix)]
    if sensor.gain is not None:
        columns = [c * sensor.gain for c in columns]
    stacked = torch.stack(columns, 1).flatten(2).double()
    weighted = stacked * weight.flatten(1)[:, None].double()
    normal = weighted @ stacked.mT
    normal = normal + 1e-9 * torch.diag_embed(torch.diagonal(normal, dim1=-2, dim2=-1) + 1e-30)
    found = torch.linalg.solve(normal, (weighted @ observed.flatten(1)[:, :, None].double())[..., 0])
    step = found[:, 1:] / torch.where(found[:, :1].abs() < 1e-30, torch.ones_like(found[:, :1]), found[:, :1])
    return torch.clamp(step, -MOST, MOST).to(sensor.iy.dtype)
