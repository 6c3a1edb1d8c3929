"""Effects of the pupil: what the path to the image plane passes or delays."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from trainer.effects.definition import Parameter, effect
from trainer.effects.free_form import FreeForm
from trainer.effects.starts import distance_starts, wavelength_starts
from trainer.effects.term_names import aberration_terms
from trainer.effects.zernike import zernike_count, zernike_surface
from trainer.prediction.stages import Pupil


@effect(
    stage="pupil",
    acts_on="display",
    parameters=[
        Parameter(
            "offset",
            "mm",
            scale=0.03,
            low=-1000,
            high=1000,
            about="how much farther from the panel the image plane is than asked for",
            typical=(-3, 3),
            example=0.6,
        )
    ],
    starts=distance_starts,
    formula=r"H(f_x, f_y) = \exp\Bigl[\,2\pi j\,(z + \Delta z)\sqrt{\lambda^{-2} - f_x^2 - f_y^2}\,\Bigr]",
)
def distance(pupil: Pupil, offset: Tensor) -> Pupil:
    """The image plane is not where the captures state it.

    Light is propagated by the angular spectrum to a plane that is nearer or farther than the real one. The picture
    is out of focus, and each edge gets fringes.

    References
    ----------
    Goodman, Introduction to Fourier Optics, section 3.10.

    Matsushima and Shimobaba 2009, Band-limited angular spectrum method for numerical simulation of free-space
    propagation in far and near fields, Opt. Express 17, 19662.
    """
    return replace(pupil, distance=pupil.distance + 1e-3 * offset)


@effect(
    stage="pupil",
    acts_on="display",
    same_as="distance",
    parameters=[
        Parameter(
            "offset",
            "nm",
            scale=0.3,
            low=-100,
            high=100,
            per_channel=True,
            about="how much longer each colour's wavelength is than stated",
            typical=(-15, 15),
            example=8.0,
        )
    ],
    starts=wavelength_starts,
    formula=r"H(f_x, f_y) = \exp\Bigl[\,2\pi j\,z\sqrt{(\lambda + \Delta\lambda)^{-2} - f_x^2 - f_y^2}\,\Bigr]",
)
def wavelength(pupil: Pupil, offset: Tensor) -> Pupil:
    """A wavelength is not what bench.toml states.

    Near the axis light arrives by wavelength x distance / pitch^2 alone, so in one colour and at one plane this is a
    distance. Diode lasers differ by some nanometres from their data sheet, and drift with temperature.

    References
    ----------
    Goodman, Introduction to Fourier Optics, section 3.10.
    """
    line = pupil.emitting(1e-9 * offset.reshape(1), torch.ones(1, dtype=offset.dtype))
    return replace(line, nominal_offset=1e-9 * offset)


def _delayed(pupil: Pupil, waves: Tensor) -> Pupil:
    return pupil.delayed(waves * pupil.reference_wavelength)


@effect(
    stage="pupil",
    acts_on="display",
    colours="either",
    orders=(4, 6),
    free_form=FreeForm(_delayed, "waves", 0.02),
    parameters=[
        Parameter(
            "zernike",
            "waves",
            scale=0.02,
            low=-10,
            high=10,
            count=lambda order: zernike_count(order, without_defocus=True),
            about="Noll-normalised terms from astigmatism on, at the first channel's wavelength",
            typical=(-0.5, 0.5),
            example=(0.0, 0.0, 0.0, 0.2),
            terms=aberration_terms,
        )
    ],
    formula=r"H' = H\,\exp\Bigl[\,2\pi j\,\dfrac{\lambda_1}{\lambda} \sum_k\,z_k\,Z_k(u, v)\Bigr]",
)
def pupil_aberration(pupil: Pupil, zernike: Tensor, *, order: int) -> Pupil:
    """The relay aberrates (without piston, tilt or defocus, which other effects describe).

    The lenses between panel and image delay some spatial frequencies more than others. Each point of the picture
    becomes the aberration's own small figure.

    References
    ----------
    Noll 1976, Zernike polynomials and atmospheric turbulence, J. Opt. Soc. Am. 66, 207.

    Goodman, Introduction to Fourier Optics, section 6.4.
    """
    return _delayed(pupil, zernike_surface(zernike, pupil.v, pupil.u, order, without_defocus=True))


@effect(
    stage="pupil",
    acts_on="display",
    colours="either",
    touches_iris=True,
    rugged=True,
    parameters=[
        Parameter(
            "half_width",
            "share of band",
            scale=0.02,
            absent=lambda bench: bench.iris.half_width,
            low=0.05,
            high=1.9,
            starts=(0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
            typical=(0.1, 1.0),
            example=0.4,
        ),
        Parameter("centre_y", "share of band", scale=0.02, low=-0.9, high=0.9, typical=(-0.4, 0.4)),
        Parameter("centre_x", "share of band", scale=0.02, low=-0.9, high=0.9, typical=(-0.4, 0.4)),
        Parameter(
            "roundness",
            "1",
            scale=0.1,
            absent=lambda bench: 1.0 if bench.iris.shape == "circle" else 0.0,
            low=0,
            high=1,
            starts=(0.0, 1.0),
            about="0 a rectangle, 1 an ellipse, between them round corners",
        ),
        Parameter(
            "stretch",
            "1",
            scale=0.02,
            low=-0.8,
            high=0.8,
            about="how much wider along x, and narrower along y",
            typical=(-0.4, 0.4),
        ),
        Parameter("rotation", "deg", scale=2.0, low=-90, high=90, about="from x towards y"),
        Parameter(
            "edge",
            "share of band",
            scale=0.02,
            low=0,
            high=1,
            about="width over which the edge goes from passing to blocking",
            typical=(0, 0.3),
        ),
    ],
    formula=(
        r"A(u,v) = \mathrm{clip}\bigl[\frac{1}{2} - d\bigl(R_\theta(\mathbf{u} - \mathbf{c});\, w(1 \pm s),"
        r"\, \rho\bigr) / e\bigr]"
    ),
)
def iris(
    pupil: Pupil,
    half_width: Tensor,
    centre_y: Tensor,
    centre_x: Tensor,
    roundness: Tensor,
    stretch: Tensor,
    rotation: Tensor,
    edge: Tensor,
) -> Pupil:
    """The filter in the Fourier plane has another size, place or shape than stated.

    The opening in the Fourier plane that blocks the panel's higher orders is smaller, larger or beside its place.
    It removes fine detail that the model still expects, or lets through light that the model blocks. In the formula d
    is the distance beyond the edge of a rectangle with half sides w(1 + s) and w(1 - s), whose corners are round by
    the share rho.

    References
    ----------
    Goodman, Introduction to Fourier Optics, chapter 6.
    """
    centre = (pupil.centre[0] + centre_y, pupil.centre[1] + centre_x)
    return replace(
        pupil,
        half_width=half_width,
        centre=centre,
        roundness=roundness,
        stretch=stretch,
        rotation=math.pi / 180 * rotation,
        edge=edge,
    )
