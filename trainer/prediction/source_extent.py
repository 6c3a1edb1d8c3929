"""Light of a source with an extent: each of its directions moves the picture, and the light within the iris."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from runtime.lightpath.fft import irfft2, rfft2
from trainer.kept_results import kept_for_same
from trainer.prediction.stages import Pupil, SourceExtent

NODE = math.sqrt(2)  # rms angles from the axis at which the iris is moved; 1 and 1.7 err more for a disc
STEP = 0.05  # rad, over the rms angle: of the differences that stand for the characteristic function's derivatives


class Tilt(NamedTuple):
    """Light at an angle (rad) to either side along an axis, and the pupils that it goes through."""

    axis: int
    angle: Tensor
    ahead: Pupil
    behind: Pupil


class Aside(NamedTuple):
    """What tilted light changes, as spectra [..., iy, ix]: the part that changes sign with the tilt, and the rest."""

    tilt: Tilt
    odd: Tensor
    even: Tensor

    def of(self, k: int) -> Aside:
        """Those of capture k alone."""
        return Aside(self.tilt, self.odd[k : k + 1], self.even[k : k + 1])


def lit_by_extent(
    pupil: Pupil, image_of: Callable[[Pupil], Tensor], near: Sequence[Aside] = ()
) -> tuple[Tensor, tuple[Aside, ...]]:
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
    near : sequence of Aside, optional
        Of a light path that is a small step away behind the same pupil, for a derivative: what tilted light does to the
        picture is taken from there, which leaves one picture of five. A derivative with respect to what the panel does
        errs by a few percent, and one with respect to the extent by what a parabola may.

    Returns
    -------
    Tensor [..., ny, nx]
    tuple of Aside
        Of the axes along which light is tilted.

    References
    ----------
    Goodman, Introduction to Fourier Optics, section 6.1; Goodman, Statistical Optics, chapter 7.
    """
    image = image_of(pupil)
    if pupil.extent is None:
        return image, ()
    known, asides = {one.tilt.axis: one for one in near}, []
    spectrum = rfft2(image) * extent_transfer(pupil)
    for tilt in _tilts(pupil):
        aside = known.get(tilt.axis)
        if aside is None:
            ahead, behind = image_of(tilt.ahead), image_of(tilt.behind)
            aside = Aside(tilt, rfft2(ahead - behind), rfft2(ahead + behind - 2 * image))
        odd, even = _aside_transfers(pupil, aside.tilt)
        spectrum = spectrum + aside.odd * odd + aside.even * even
        asides.append(aside)
    blurred: Tensor = irfft2(spectrum, (image.shape[-2], image.shape[-1]))
    return blurred, tuple(asides)


@kept_for_same(2)  # of a fit's model and of its trial
def extent_transfer(pupil: Pupil) -> Tensor:
    """What the extent does to irradiance over (iy, ix) where the iris's edge takes nothing of tilted light."""
    assert pupil.extent is not None
    turns = _turns(pupil)
    return pupil.extent.core(*turns) + pupil.extent.halo(*turns)


@kept_for_same(2)  # of a fit's model and of its trial
def _tilts(pupil: Pupil) -> list[Tilt]:
    """Tilted light that stands for the extent's, of each axis that has an extent."""
    assert pupil.extent is not None
    found = []
    for axis, rms in enumerate(pupil.extent.rms):
        if float(rms.detach()) == 0:
            continue
        # Shares of the band. The iris's edge goes through frequency samples: less than one tells no curvature.
        unit, sample = 2 * pupil.pitch / pupil.wavelength, _spacing((pupil.v, pupil.u)[axis])
        moved = torch.clamp(NODE * unit * rms, min=sample)
        ahead, behind = (_with_iris_moved(pupil, axis, by) for by in (-moved, moved))
        found.append(Tilt(axis, moved / unit, ahead, behind))
    return found


@kept_for_same(4)  # of both axes
def _aside_transfers(pupil: Pupil, tilt: Tilt) -> tuple[Tensor, Tensor]:
    """What the extent does to what tilted light does to the picture, over (iy, ix): to its odd and its even part."""
    extent: SourceExtent | None = pupil.extent
    assert extent is not None
    down, across = _turns(pupil)
    step = STEP / extent.rms[tilt.axis]
    above, below = (
        extent.core(down + s, across) if tilt.axis == 0 else extent.core(down, across + s)
        for s in (step, -step)
    )
    odd = 1j * (above - below) / (4 * step * tilt.angle)
    even = (2 * extent.core(down, across) - above - below) / (2 * (step * tilt.angle) ** 2)
    return odd, even


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
