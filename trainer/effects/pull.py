"""Which way the data pull a map or a curve of one stage: starting points for effects that a person writes.

The misfit's derivative with respect to every number of a map costs one pass forward and one back. A stripe, a
ripple or a fringe stands out in it, so a fit can start near it instead of trying every period.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainer.effects.evidence import Evidence
from trainer.prediction.predict import light_on_camera, trace
from trainer.prediction.scene import bare_stages

MOST_CAPTURES = 3
FINER = 8  # samples of the spectrum a whole cycle over the map: a peak is placed to a fraction of a cycle


def pull(
    evidence: Sequence[Evidence], stage: str, change: Callable[[Any, Tensor], Any], shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """How strongly the residual asks for each number of a map, float64 [*shape], from the first captures.

    stage : whose map it is
    change : `(stage, map) -> stage`; at a map of zeros the stage is as it was
    Where the result is positive, a positive number would lessen the misfit. Effects that are in the model
    already are in the residual, but not in how light reacts to the map.
    """
    one = evidence[0]
    total = np.zeros(shape)
    with torch.enable_grad():
        surface = torch.zeros(shape, dtype=one.scene.dtype, requires_grad=True)
        bare = bare_stages(one.scene)
        for k in range(min(MOST_CAPTURES, one.batch.gray.shape[0])):
            stages = replace(bare, **{stage: change(getattr(bare, stage), surface)})
            light = light_on_camera(
                one.scene, stages, trace(one.scene, stages, one.batch.gray[k : k + 1]).image
            )[0]
            if stages.sensor.gain is not None:
                light = light * stages.sensor.gain
            seen = light.detach()
            gain = (seen * one.prediction[k]).sum() / (seen**2).sum()
            residual = (one.batch.signal[k] - one.prediction[k]) * one.batch.mask[k]
            (slope,) = torch.autograd.grad((residual * light * gain).sum(), surface)
            total += slope.double().numpy()
    return total


@dataclass(frozen=True)
class Wave:
    """A sinusoid that a map holds: cycles a sample along each axis (from 0 on along the last), and its
    cosine's and sine's share, of 1.

    Its angle is zero at the map's centre: `cosine * cos(a) + sine * sin(a)` with `a = 2 pi sum(frequency *
    place)` and places counted in samples from the centre.
    """

    frequency: tuple[float, ...]
    cosine: float
    sine: float


def waves(array: NDArray[np.float64], most: int = 3, slowest: float = 1.5) -> list[Wave]:
    """The strongest sinusoids of a curve or a map, strongest first; `slowest` is in cycles over the whole of
    it.
    """
    sizes = [FINER * n for n in array.shape]
    if array.ndim > 1:
        sizes = [2 * n for n in array.shape]
    tapered = array - array.mean()
    spectrum = np.fft.fftn(tapered, sizes, tuple(range(array.ndim)))
    grid = np.meshgrid(*(np.fft.fftfreq(n) for n in sizes), indexing="ij")
    cycles = np.sqrt(sum((f * n) ** 2 for f, n in zip(grid, array.shape, strict=True)))
    size = np.abs(spectrum) * ((cycles >= slowest) & (grid[-1] >= 0))
    found = []
    for _ in range(most):
        place = np.unravel_index(int(size.argmax()), size.shape)
        if size[place] <= 0:
            break
        frequency = tuple(float(f[place]) for f in grid)
        turn = np.exp(2j * np.pi * sum(f * (n - 1) / 2 for f, n in zip(frequency, array.shape, strict=True)))
        value = spectrum[place] * turn / abs(spectrum[place])
        found.append(Wave(frequency, float(value.real), float(-value.imag)))
        for sign in (1, -1):
            off = sum(((f - sign * g) * n) ** 2 for f, g, n in zip(grid, frequency, array.shape, strict=True))
            size = np.where(off < 1, 0, size)
    return found
