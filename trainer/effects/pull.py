"""In which direction the captures pull a map or a curve of one stage: starting points for users' own effects.

The misfit's derivative with respect to every number of a map costs one forward and one backward pass. A stripe, a
ripple or a fringe is clearly visible in it, so a fit can start near it and need not try every period.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainer.device import array_of
from trainer.effects.evidence import Evidence
from trainer.prediction.camera_light import light_on_camera
from trainer.prediction.predict import trace
from trainer.prediction.scene import bare_stages

MOST_CAPTURES = 3
FINER = 8  # samples of the spectrum for one cycle over the map: a peak is located to a fraction of a cycle


def pull(
    evidence: Sequence[Evidence], stage: str, change: Callable[[Any, Tensor], Any], shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """How strongly the residual of the first captures pulls each number of a map.

    Effects that are in the model already are in the residual, but not in the light's response to the map.

    Parameters
    ----------
    evidence : sequence of Evidence
        Only the first one is used.
    stage : str
        The stage that the map belongs to.
    change : callable
        `(stage, map) -> stage`; a map of zeros leaves the stage as it is.
    shape : tuple of int
        The map's.

    Returns
    -------
    float64 array [*shape]
        Where it is positive, a positive number would reduce the misfit.
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
            fixed = light.detach()
            gain = (fixed * one.prediction[k]).sum() / (fixed**2).sum()
            residual = (one.batch.signal[k] - one.prediction[k]) * one.batch.mask[k]
            (slope,) = torch.autograd.grad((residual * light * gain).sum(), surface)
            total += array_of(slope.double())
    return total


@dataclass(frozen=True)
class Wave:
    """A sinusoid in a map: `cosine * cos(a) + sine * sin(a)` with `a = 2 pi sum(frequency * place)`.

    Places are counted in samples from the map's centre.

    Attributes
    ----------
    frequency : tuple of float, cycles/sample
        Along each axis; not negative along the last.
    cosine, sine : float
        Their squares add up to 1.
    """

    frequency: tuple[float, ...]
    cosine: float
    sine: float


def waves(array: NDArray[np.float64], most: int = 3, slowest: float = 1.5) -> list[Wave]:
    """The strongest sinusoids of a curve or a map.

    Parameters
    ----------
    array : float64 array
        A curve or a map, such as `pull` returns.
    most : int
    slowest : float
        Cycles over the whole array; slower ones are left out.

    Returns
    -------
    list of Wave
        Strongest first.
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
