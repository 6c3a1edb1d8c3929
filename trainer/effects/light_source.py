"""Effects of the light source: its lines and its extent, which the path to the image plane makes incoherent."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from trainer.effects.blur_kernel import CORE_AND_HALO, kernel_core, kernel_halo
from trainer.effects.definition import Parameter, effect
from trainer.prediction.stages import Pupil, SourceExtent

# A laser line is a sum of wavelengths, evenly apart out to so many standard deviations, five to MOST_LINES of them.
LINE_REACH, FEWEST_LINES, MOST_LINES = 3.0, 5, 13
FWHM = 2 * math.sqrt(2 * math.log(2))


@effect(
    stage="pupil",
    acts_on="display",
    colours="apart",
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
    colours="apart",
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
    colours="either",
    touches_iris=True,
    parameters=[
        *(
            Parameter(
                f"extent_{axis}",
                "mrad",
                scale=0.3,
                low=0,
                high=50,
                even=True,
                starts=(0.1, 0.3, 1.0),
                about="rms angle",
                typical=(0, 3),
                example=1.0,
            )
            for axis in "yx"
        ),
        *CORE_AND_HALO,
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
