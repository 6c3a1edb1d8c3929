"""Displacement and blur of each capture's picture, measured from the capture itself."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from trainer.prediction.stages import Sensor

STEPS = 3  # of Gauss-Newton; displacements are a small part of a speckle
MOST = 1.0  # panel pixels that one step may move
BLUR_STEP, TRIED_BLURS = 0.3, 8  # between widths that are tried, as shares of the usual one; how many at once
WIDEST_BLURS = 4  # times as many are tried where the widest of them fits best


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


def blurred_spectrum(
    sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor], measured: tuple[Tensor, Tensor]
) -> Tensor:
    """The spectrum of pictures, each blurred as much as its capture is.

    Parameters
    ----------
    sensor : Sensor
        With a blur of each capture's own.
    spectrum, read, measured
        As in `displaced_spectrum`.
    """
    blur = sensor.capture_blur
    assert blur is not None
    with torch.no_grad():
        observed, weight = _flat(sensor, measured)
        scores: list[Tensor] = []
        while len(scores) < WIDEST_BLURS * TRIED_BLURS:
            for _ in range(TRIED_BLURS):
                ratio = torch.tensor(BLUR_STEP * len(scores), dtype=sensor.iy.dtype)
                picture = _on_sensor(sensor, read(spectrum * blur(ratio**2))).flatten(1).double()
                # With the best brightness, the misfit falls by (m . p)^2 / (p . p).
                power = (weight * picture**2).sum(1).clamp(min=1e-30)
                scores.append((weight * picture * observed).sum(1) ** 2 / power)
            score = torch.stack(scores, 1)
            if bool((score.argmax(1) < len(scores) - 1).all()):
                break
        best = score.argmax(1).clamp(1, len(scores) - 2)
        before, here, after = (score.gather(1, best[:, None] + k)[:, 0] for k in (-1, 0, 1))
        bend = before - 2 * here + after
        part = torch.where(bend < 0, 0.5 * (before - after) / torch.where(bend < 0, bend, -1.0), 0.0)
        part = torch.where(bend < 0, part, torch.sign(after - before))
        amount = ((best + part.clamp(-1, 1)).to(ratio.dtype) * BLUR_STEP) ** 2
    return spectrum * torch.stack([blur(a) for a in amount])


def _flat(sensor: Sensor, measured: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Signal without added light, and weight: [B, pixels]."""
    observed, weight = measured
    if sensor.offset is not None:
        observed = observed - sensor.offset
    return observed.flatten(1).double(), weight.flatten(1).double()


def _on_sensor(sensor: Sensor, light: Tensor) -> Tensor:
    return light if sensor.gain is None else light * sensor.gain


def _ramp(sensor: Sensor, shift: Tensor) -> Tensor:
    """Transfer functions of displacements [B, 2], panel pixels: light of a place that much farther on."""
    angle = 2 * math.pi * (sensor.iy * shift[..., :1, None] + sensor.ix * shift[..., 1:, None])
    return torch.polar(torch.ones_like(angle), angle)


def _step(
    sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor], measured: tuple[Tensor, Tensor]
) -> Tensor:
    """Displacements [B, 2] that fit the pictures better, each with a brightness of its own."""
    observed, weight = _flat(sensor, measured)
    columns = [read(spectrum)]
    columns += [read(spectrum * (2j * math.pi * f)) for f in (sensor.iy, sensor.ix)]
    stacked = torch.stack([_on_sensor(sensor, c) for c in columns], 1).flatten(2).double()
    weighted = stacked * weight[:, None]
    normal = weighted @ stacked.mT
    normal = normal + 1e-9 * torch.diag_embed(torch.diagonal(normal, dim1=-2, dim2=-1) + 1e-30)
    found = torch.linalg.solve(normal, (weighted @ observed[:, :, None])[..., 0])
    step = found[:, 1:] / torch.where(found[:, :1].abs() < 1e-30, torch.ones_like(found[:, :1]), found[:, :1])
    return torch.clamp(step, -MOST, MOST).to(sensor.iy.dtype)
