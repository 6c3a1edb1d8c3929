"""Effects of the pupil: what the path to the image plane passes, delays or makes incoherent."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from trainer.effects.bessel import bessel_j0, bessel_j1_over_x
from trainer.effects.definition import Parameter, effect
from trainer.effects.free_form import FreeForm
from trainer.effects.starts import distance_starts, wavelength_starts
from trainer.effects.term_names import aberration_terms
from trainer.effects.zernike import zernike_count, zernike_surface
from trainer.prediction.stages import Pupil, SourceExtent

# A laser line is a sum of wavelengths, evenly apart out to so many standard deviations, five to MOST_LINES of them.
LINE_REACH, FEWEST_LINES, MOST_LINES = 3.0, 5, 13
FWHM = 2 * math.sqrt(2 * math.log(2))


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
    return pupil.emitting(1e-9 * offset.reshape(1), torch.ones(1, dtype=offset.dtype))


def _delayed(pupil: Pupil, waves: Tensor) -> Pupil:
    return pupil.delayed(waves * pupil.reference_wavelength)


@effect(
    stage="pupil",
    acts_on="display",
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


@effect(
    stage="pupil",
    acts_on="display",
    parameters=[
        Parameter(
            "line_width",
            "nm",
            scale=0.3,
            low=0,
            high=40,
            even=True,
            starts=(0.5, 2.0),
            typical=(0, 40),
            example=25.0,
        )
    ],
    formula=(
        r"I = \int s(\delta)\,I_{\lambda+\delta}\,\mathrm{d}\delta, \qquad s:\ \text{Gaussian,"
        r" full width } \Delta\lambda"
    ),
)
def temporal_coherence(pupil: Pupil, line_width: Tensor) -> Pupil:
    """The laser has a line width (full width at half maximum of a Gaussian line).

    A laser diode emits a band of wavelengths, and each one forms its own picture with its own diffraction. They add
    as light, not as waves: fine structure blurs, most where light comes at steep angles.

    References
    ----------
    Deng and Chu 2017, Coherence properties of different light sources and their effect on the image sharpness and
    speckle of holographic displays, Sci. Rep. 7, 5893.
    """
    deviation = 1e-9 / FWHM * line_width
    count = _lines_needed(pupil, float(deviation.detach()))
    nodes = torch.linspace(-LINE_REACH, LINE_REACH, count, dtype=line_width.dtype)
    weights = torch.exp(-0.5 * nodes**2)
    weights = weights / weights.sum()
    nodes = nodes / torch.sqrt((weights * nodes**2).sum())  # what is cut off at the ends
    return pupil.emitting(nodes * deviation, weights)


def _lines_needed(pupil: Pupil, deviation: float) -> int:
    """Wavelengths that add up like a Gaussian line with a standard deviation (m).

    Each displaces what passes near the iris's edge; between two of them, light there may turn against the rest by less
    than a whole turn, with room for the width of the line's own characteristic function.
    """
    edge = float(pupil.half_width.detach()) / (2 * pupil.pitch)
    turned = (
        1.5 * math.pi * abs(float(pupil.distance.detach())) * deviation * edge**2
    )  # rad, towards the corner
    return min(
        FEWEST_LINES + 2 * math.ceil(max(LINE_REACH * (turned + 3) / (2 * math.pi) - 2, 0)), MOST_LINES
    )


@effect(
    stage="pupil",
    acts_on="display",
    orders=(1, 2),
    parameters=[
        Parameter(
            "separation",
            "nm",
            scale=0.2,
            absent=4.0,
            low=-60,
            high=60,
            count=lambda order: order,
            starts=(-24.0, -12.0, -6.0, -3.0, -1.5, 1.5, 3.0, 6.0, 12.0, 24.0),
            about="of each further line from the stated wavelength",
            typical=(-20, 20),
        ),
        Parameter(
            "share",
            "1",
            scale=0.03,
            low=-0.2,
            high=0.5,
            count=lambda order: order,
            about="of the light in each further line",
            typical=(0, 0.5),
            example=0.4,
        ),
    ],
    formula=r"I = \Bigl(1 - \sum_k\,p_k\Bigr)\,I_\lambda + \sum_k\,p_k\,I_{\lambda+\delta_k}",
)
def source_lines(pupil: Pupil, separation: Tensor, share: Tensor) -> Pupil:
    """The source has two or more spectral lines or modes.

    A laser diode may emit in several modes at once, and a lamp in several lines. Each forms its own picture with its
    own diffraction, and they add as light: beside every bright point stands a second, displaced outwards or inwards.

    References
    ----------
    Saleh and Teich 2007, Fundamentals of Photonics, chapter 17.
    """
    offsets = torch.cat((torch.zeros_like(separation[:1]), 1e-9 * separation))
    return pupil.emitting(offsets, torch.cat((1 - share.sum().reshape(1), share)))


@effect(
    stage="pupil",
    acts_on="display",
    touches_iris=True,
    parameters=[
        Parameter(
            "extent_y",
            "mrad",
            scale=0.3,
            low=0,
            high=50,
            even=True,
            starts=(0.1, 0.3, 1.0),
            about="rms angle",
            typical=(0, 3),
            example=1.0,
        ),
        Parameter(
            "extent_x",
            "mrad",
            scale=0.3,
            low=0,
            high=50,
            even=True,
            starts=(0.1, 0.3, 1.0),
            about="rms angle",
            typical=(0, 3),
            example=1.0,
        ),
        Parameter(
            "kurtosis",
            "1",
            scale=0.5,
            low=-1.5,
            high=1.5,
            about="shape: 0 Gaussian, -1 uniform disc, -1.5 ring",
            typical=(-1.5, 1.5),
        ),
        Parameter(
            "halo",
            "1",
            scale=0.05,
            low=0,
            high=0.9,
            about="share of the light in a wider, round part",
            typical=(0, 0.5),
        ),
        Parameter(
            "halo_extent",
            "mrad",
            scale=0.3,
            absent=1.0,
            low=0.01,
            high=100,
            about="rms angle of that part",
            typical=(0.1, 20),
            example=5.0,
        ),
    ],
    formula=(
        r"\hat{I}' = \hat{I}\,\bigl[(1-h)\,K_\kappa(w) + h\,K_0(w_h)\bigr],"
        r" \quad K_0 = e^{-w^2/2}, \quad K_{-1} = J_1(2w)/w, \quad K_{-1.5} = J_0(\sqrt{2}\,w),"
        r" \qquad w = 2\pi z \sqrt{(\theta_x f_x)^2 + (\theta_y f_y)^2}"
    ),
)
def spatial_coherence(
    pupil: Pupil, extent_y: Tensor, extent_x: Tensor, kurtosis: Tensor, halo: Tensor, halo_extent: Tensor
) -> Pupil:
    """The source has an extent: each of its points tilts the light and displaces the picture by distance x angle.

    A source that is not a point lights the panel from many angles at once. Each angle moves the picture by distance
    times angle, and the sum is a blur that grows with the distance.

    References
    ----------
    Deng and Chu 2017, Coherence properties of different light sources and their effect on the image sharpness and
    speckle of holographic displays, Sci. Rep. 7, 5893.
    """
    widths = 1e-3 * extent_y, 1e-3 * extent_x

    def core(ky: Tensor, kx: Tensor) -> Tensor:
        return (1 - halo) * kernel_core(ky, kx, widths, kurtosis)

    def outer(ky: Tensor, kx: Tensor) -> Tensor:
        return halo * kernel_halo(ky, kx, 1e-3 * halo_extent)

    return replace(pupil, extent=SourceExtent(core, outer, widths))


def kernel_transfer(
    iy: Tensor, ix: Tensor, widths: tuple[Tensor, Tensor, Tensor], kurtosis: Tensor, halo: Tensor
) -> Tensor:
    """Transfer function of a blur kernel with a core and a halo.

    Parameters
    ----------
    iy, ix : Tensor
        Image frequencies, in cycles per unit of `widths`.
    widths : (Tensor, Tensor, Tensor)
        rms along rows and columns, and of the halo.
    kurtosis : Tensor
    halo : Tensor
        Its share of the light.

    Returns
    -------
    Tensor [n, m]
    """
    ky, kx = 2 * math.pi * iy, 2 * math.pi * ix
    return (1 - halo) * kernel_core(ky, kx, widths[:2], kurtosis) + halo * kernel_halo(ky, kx, widths[2])


def kernel_core(ky: Tensor, kx: Tensor, widths: tuple[Tensor, Tensor], kurtosis: Tensor) -> Tensor:
    """Transfer function of a core, the same rms width whatever its kurtosis, over radians per unit of `widths`.

    With w = k width: at a kurtosis of 0 a Gaussian, exp(-w^2/2); at -1 a uniform disc, J1(2w)/w; at -1.5 a ring,
    J0(sqrt(2) w); between two of these a sum of both. Above 0 it is the first two even cumulants,
    exp(-w^2/2 + kurtosis w^4/24), the second limited to half of the first, where the expansion ends.
    """
    w2 = (widths[0] * ky) ** 2 + (widths[1] * kx) ** 2
    peaked = torch.exp(w2 * (torch.clamp(kurtosis * w2 / 24, 0, 0.25) - 0.5))
    return peaked if float(kurtosis.detach()) >= 0 else _flat_topped(w2, -kurtosis, peaked)


def kernel_halo(ky: Tensor, kx: Tensor, width: Tensor) -> Tensor:
    """Transfer function of a round Gaussian halo, over radians per unit of its rms width."""
    return torch.exp(-0.5 * width**2 * (ky**2 + kx**2))


def _flat_topped(w2: Tensor, flatness: Tensor, gaussian: Tensor) -> Tensor:
    """The core between a Gaussian (flatness 0), a disc (1) and a ring (1.5), at squared frequencies w^2."""
    w = torch.sqrt(torch.clamp(w2, min=1e-8))  # a quotient has no value at 0
    disc = 2 * bessel_j1_over_x(2 * w)
    if float(flatness.detach()) <= 1:
        return torch.lerp(gaussian, disc, flatness)
    return torch.lerp(disc, bessel_j0(math.sqrt(2) * w), 2 * (flatness - 1))
