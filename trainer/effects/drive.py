"""Effects of the drive: from a pixel's gray level and its neighbours' to its phase."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from runtime.lightpath.legendre import legendre_count, legendre_curve, legendre_surface
from trainer.effects.definition import Parameter, effect
from trainer.effects.free_form import FreeForm, along
from trainer.effects.term_names import curve_terms, driver_terms, surface_terms
from trainer.prediction.stages import Drive

SUB_PIXELS = 4  # of a pixel along each axis; 3 leave an excess of 9e-4, 5 gain nothing visible to a camera
REACH = 4  # neighbours on either side that act on a pixel; 2 leave 6e-4 where the field decays over 0.6


def _bent(drive: Drive, deviation: Tensor) -> Drive:
    bend = along(deviation, drive.level / drive.level[-1])
    return replace(drive, response=drive.response + drive.sign * bend)


@effect(
    stage="drive",
    acts_on="display",
    orders=(2, 4, 6, 10, 16),
    free_form=FreeForm(_bent, "rad", 0.05, curve=True),
    parameters=[
        Parameter(
            "gain",
            "1",
            scale=0.02,
            absent=1.0,
            low=0.2,
            high=3.0,
            per_channel=True,
            starts=(0.8, 0.9, 1.0, 1.1, 1.2, 1.35),
            about="phase at the last gray level over its nominal value",
            typical=(0.7, 1.3),
            example=0.95,
        ),
        Parameter(
            "curvature",
            "rad",
            scale=0.1,
            low=-6,
            high=6,
            count=lambda order: order,
            per_channel=True,
            about="Legendre terms of the deviation from the straight line, zero at both ends",
            typical=(-1.5, 1.5),
            terms=curve_terms,
        ),
    ],
    formula=r"\varphi(g) = 2\pi a\,t + 4t(1-t)\sum_n\,c_n P_n(2t-1), \qquad t = g/256",
)
def phase_response(drive: Drive, gain: Tensor, curvature: Tensor) -> Drive:
    """Gray to phase is not the straight line that the bench file states.

    The liquid crystal turns further or less far than its nominal wave, and not evenly from one gray level to the
    next. Light then lands in the unmodulated spot and in false images, and contrast falls.

    References
    ----------
    Reichelt 2013, Spatially resolved phase-response calibration of liquid-crystal-based spatial light modulators,
    Appl. Opt. 52, 2610.

    Schroff et al. 2024, Rapid stochastic spatial light modulator calibration and pixel crosstalk optimisation,
    arXiv:2408.07672.
    """
    t = drive.level
    bend = t * (1 - t) * 4 * (curvature @ legendre_curve(2 * t - 1, curvature.shape[0]))
    return replace(drive, response=drive.response * gain + drive.sign * bend)


def _scaled(drive: Drive, change: Tensor) -> Drive:
    return drive.scaled(1 + change)


@effect(
    stage="drive",
    acts_on="display",
    orders=(2, 4, 6, 8, 10),
    free_form=FreeForm(_scaled, "1", 0.02),
    parameters=[
        Parameter(
            "map",
            "1",
            scale=0.02,
            low=-0.8,
            high=0.8,
            count=legendre_count,
            about="Legendre terms of the relative change of the phase's gain over the panel",
            typical=(-0.3, 0.3),
            example=(0.0, 0.0, 0.15),
            terms=surface_terms,
        )
    ],
    formula=r"\varphi'(x,y) = \varphi(x,y)\,\Bigl[1 + \sum_{i,j}\,m_{ij}\,P_i(y)\,P_j(x)\Bigr]",
)
def phase_nonuniformity(drive: Drive, map: Tensor) -> Drive:
    """The phase's gain varies over the panel, as the cell's thickness does.

    Where the liquid crystal's layer is thicker, the same voltage gives more phase. One response table for the whole
    panel then fits in some places and not in others.

    References
    ----------
    Reichelt 2013, Spatially resolved phase-response calibration of liquid-crystal-based spatial light modulators,
    Appl. Opt. 52, 2610.

    Schroff et al. 2024, Rapid stochastic spatial light modulator calibration and pixel crosstalk optimisation,
    arXiv:2408.07672.
    """
    return _scaled(drive, legendre_surface(map, drive.y, drive.x))


@effect(
    stage="drive",
    acts_on="display",
    parameters=[
        Parameter(
            "width_y",
            "pixels",
            scale=0.08,
            low=0,
            high=1.5,
            even=True,
            starts=(0.1, 0.3),
            typical=(0, 0.5),
            example=0.05,
        ),
        Parameter(
            "width_x",
            "pixels",
            scale=0.08,
            low=0,
            high=1.5,
            even=True,
            starts=(0.1, 0.3),
            typical=(0, 0.5),
            example=0.05,
        ),
        Parameter("asymmetry_y", "1", scale=0.2, low=-1, high=1, typical=(-1, 1)),
        Parameter("asymmetry_x", "1", scale=0.2, low=-1, high=1, typical=(-1, 1)),
    ],
    formula=(
        r"\varphi' = k_y * k_x * \varphi, \qquad k(x) \propto e^{-|x|/r_\pm}, "
        r"\qquad r_\pm = \frac{w}{\sqrt{2}}\,(1 \pm a) \ \mathrm{for}\ x \gtrless 0"
    ),
)
def crosstalk(
    drive: Drive, width_y: Tensor, width_x: Tensor, asymmetry_y: Tensor, asymmetry_x: Tensor
) -> Drive:
    """Fringing fields: neighbouring pixels' voltages mix over a fraction of a pixel.

    The electric field of a pixel reaches into its neighbours, so steep steps of phase become ramps. Jumps from one
    wave to zero suffer most: light leaves the picture at every such jump.

    References
    ----------
    Persson et al. 2012, Reducing the effect of pixel crosstalk in phase only spatial light modulators, Opt. Express
    20, 22334.

    Schroff et al. 2024, Rapid stochastic spatial light modulator calibration and pixel crosstalk optimisation,
    arXiv:2408.07672.
    """
    return replace(drive, crosstalk=(_taps(width_y, asymmetry_y), _taps(width_x, asymmetry_x)))


@effect(
    stage="drive",
    acts_on="display",
    parameters=[
        Parameter(
            "columns_offset",
            "rad",
            scale=0.02,
            low=-2,
            high=2,
            count=5,
            about="phase that repeats every 2, 3 and 4 columns",
            typical=(-0.3, 0.3),
            example=(0.2,),
            terms=driver_terms,
        ),
        Parameter(
            "rows_offset",
            "rad",
            scale=0.02,
            low=-2,
            high=2,
            count=5,
            about="phase that repeats every 2, 3 and 4 rows",
            typical=(-0.3, 0.3),
            terms=driver_terms,
        ),
        Parameter(
            "columns_gain",
            "1",
            scale=0.01,
            low=-0.5,
            high=0.5,
            count=5,
            about="relative gain of the phase that repeats every 2, 3 and 4 columns",
            typical=(-0.1, 0.1),
            terms=driver_terms,
        ),
        Parameter(
            "rows_gain",
            "1",
            scale=0.01,
            low=-0.5,
            high=0.5,
            count=5,
            about="relative gain of the phase that repeats every 2, 3 and 4 rows",
            typical=(-0.1, 0.1),
            terms=driver_terms,
        ),
    ],
    formula=(
        r"\varphi' = (1 + a_x + a_y)\,\varphi + o_x + o_y, \qquad o_x = \sum_{p=2}^{4}\,c_p \cos\frac{2\pi x}{p}"
        r" + s_p \sin\frac{2\pi x}{p}"
    ),
)
def drivers(
    drive: Drive, columns_offset: Tensor, rows_offset: Tensor, columns_gain: Tensor, rows_gain: Tensor
) -> Drive:
    """Offset and gain of the drive repeat every few columns or rows.

    Neighbouring columns of a panel are driven by different amplifiers, and rows by different phases of a clock. Their
    small differences repeat every two, three or four lines and throw light into faint copies beside the picture.

    References
    ----------
    Armitage, Underwood and Wu 2006, Introduction to Microdisplays.
    """
    rows, columns = (_repeating(n, drive.level.dtype) for n in drive.y.shape)
    offset = (rows_offset @ rows)[:, None] + (columns_offset @ columns)[None, :]
    gain = (rows_gain @ rows)[:, None] + (columns_gain @ columns)[None, :]
    return drive.advanced(offset).scaled(1 + gain)


def _repeating(lines: int, dtype: torch.dtype) -> Tensor:
    """Waves that repeat every 2, 3 and 4 lines: [5, lines]."""
    line = torch.arange(lines, dtype=dtype)
    angles = {period: 2 * math.pi / period * line for period in (2, 3, 4)}
    return torch.stack(
        [torch.cos(angles[2])] + [wave(angles[p]) for p in (3, 4) for wave in (torch.cos, torch.sin)]
    )


def _taps(width: Tensor, asymmetry: Tensor) -> Tensor:
    """Share that each pixel has in the phase of each sub-pixel.

    The kernel is a two-sided exponential, as fringing fields decay. The share of a pixel is the kernel's integral over
    it, mean over the sub-pixel: at a sub-pixel's centre, a kernel that is narrower than that would hardly show.

    Parameters
    ----------
    width : Tensor, pixels
        The kernel's rms for equal sides.
    asymmetry : Tensor
        Lengthens one side and shortens the other, -1 to 1.

    Returns
    -------
    Tensor [SUB_PIXELS, 2 REACH + 1]
    """
    side = torch.clamp(width, min=1e-12) / math.sqrt(2)
    right, left = side * (1 + 0.999 * asymmetry), side * (1 - 0.999 * asymmetry)

    def below(x: Tensor) -> Tensor:
        """Integral from minus infinity to x of the kernel's integral from minus infinity."""
        falling = torch.exp(-torch.clamp(x, min=0) / right)
        rising = torch.exp(torch.clamp(x, max=0) / left)
        share = left / (left + right)
        beyond = torch.clamp(x, min=0) + share * left - (1 - share) * right * (1 - falling)
        return torch.where(x > 0, beyond, share * left * rising)

    edge = torch.arange(SUB_PIXELS + 1, dtype=width.dtype) / SUB_PIXELS - 0.5
    pixel = torch.arange(-REACH, REACH + 1, dtype=width.dtype)
    distance = edge[:, None] - pixel[None, :]
    taps = torch.diff(below(distance + 0.5) - below(distance - 0.5), dim=0) * SUB_PIXELS
    return taps / taps.sum(dim=1, keepdim=True)
