"""Light of a source with an extent: each of its directions moves the picture, and the light within the iris."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from runtime.lightpath.fft import irfft2, rfft2
from trainer.kept_results import kept_for_same
from trainer.prediction.stages import Pupil, SourceExtent

NODE = math.sqrt(2)  # rms angles from the axis at which the iris is moved; 1 and 1.7 err more for a disc
STEP = 0.05  # rad, over the rms angle: of the differences that stand for the characteristic function's derivatives


class _Aside(NamedTuple):
    """An axis along which light is tilted: pupils for light ahead of and behind the middle, and their factors."""

    ahead: Pupil
    behind: Pupil
    odd: Tensor
    even: Tensor


def lit_by_extent(pupil: Pupil, image_of: Callable[[Pupil], Tensor]) -> Tensor:
    """Irradiance behind a pupil, of a source with the pupil's extent.

    Light at an angle t to the axis gives the picture that the axis gives through an iris that is moved by
    t / wavelength, displaced by t times the distance. That picture is a smooth function of the iris's place, so a
    parabola through three places along each axis stands for all. Its terms in t and t^2 go with the first and the
    second derivative of the directions' characteristic function. The halo's directions keep the iris where it is.

    Parameters
    ----------
    pupil : Pupil
    image_of : callable
        Irradiance [..., ny, nx] behind a pupil, of a source that is a point.

    Returns
    -------
    Tensor [..., ny, nx]

    References
    ----------
    Goodman, Introduction to Fourier Optics, section 6.1; Goodman, Statistical Optics, chapter 7.
    """
    image = image_of(pupil)
    if pupil.extent is None:
        return image
    spectrum = rfft2(image) * extent_transfer(pupil)
    for one in _asides(pupil):
        ahead, behind = image_of(one.ahead), image_of(one.behind)
        spectrum = spectrum + rfft2(ahead - behind) * one.odd + rfft2(ahead + behind - 2 * image) * one.even
    blurred: Tensor = irfft2(spectrum, (image.shape[-2], image.shape[-1]))
    return blurred


@kept_for_same(2)  # of a fit's model and of its trial
def extent_transfer(pupil: Pupil) -> Tensor:
    """What the extent does to irradiance over (iy, ix) where the iris's edge takes nothing of tilted light."""
    assert pupil.extent is not None
    turns = _turns(pupil)
    return pupil.extent.core(*turns) + pupil.extent.halo(*turns)


@kept_for_same(2)  # of a fit's model and of its trial
def _asides(pupil: Pupil) -> list[_Aside]:
    extent: SourceExtent | None = pupil.extent
    assert extent is not None
    down, across = _turns(pupil)
    core = extent.core(down, across)
    found = []
    for axis in (0, 1):
        rms = extent.rms[axis]
        if float(rms.detach()) == 0:
            continue
        # Shares of the band. The iris's edge goes through frequency samples: less than one tells no curvature.
        unit, sample = 2 * pupil.pitch / pupil.wavelength, _spacing((pupil.v, pupil.u)[axis])
        moved = torch.clamp(NODE * unit * rms, min=sample)
        angle, step = moved / unit, STEP / rms
        above, below = (
            extent.core(down + s, across) if axis == 0 else extent.core(down, across + s)
            for s in (step, -step)
        )
        found.append(
            _Aside(
                _with_iris_moved(pupil, axis, -moved),
                _with_iris_moved(pupil, axis, moved),
                1j * (above - below) / (4 * step * angle),
                (2 * core - above - below) / (2 * (step * angle) ** 2),
            )
        )
    return found


def _turns(pupil: Pupil) -> tuple[Tensor, Tensor]:
    """How much an image frequency's phase changes with the light's angle, 1/rad: a column and a row."""
    reach = 2 * math.pi * pupil.distance
    return reach * pupil.iy, reach * pupil.ix


def _spacing(frequency: Tensor) -> float:
    first, second = frequency.reshape(-1)[:2].tolist()
    return abs(float(second - first))


def _with_iris_moved(pupil: Pupil, axis: int, by: Tensor) -> Pupil:
    v, u = pupil.centre
    return replace(pupil, centre=(v + by, u) if axis == 0 else (v, u + by), extent=None)
