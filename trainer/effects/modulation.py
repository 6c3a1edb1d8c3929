"""Effects of the drive on more than the phase: amplitude, a second polarisation, and change in time."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from runtime.lightpath.legendre import legendre_curve
from trainer.effects.definition import Parameter, effect
from trainer.effects.free_form import FreeForm, along
from trainer.effects.term_names import bent_curve_terms
from trainer.prediction.stages import Drive

# Three places and shares with the second and fourth moment of a swing that lingers evenly over its range.
SWING = (-1.304, 0.0, 1.304)
SWING_SHARES = (0.294, 0.412, 0.294)
# The second polarisation is a state of its own, seldom and strong: so light that no pattern modulates, which is in
# every state, counts in it as good as nothing.
SELDOM = 1e-3


def _absorbing(drive: Drive, change: Tensor) -> Drive:
    return drive.modulated(torch.clamp(1 + along(change, drive.level / drive.level[-1]), min=0))


@effect(
    stage="drive",
    acts_on="display",
    orders=(1, 2, 4, 6),
    free_form=FreeForm(_absorbing, "1", 0.02, curve=True),
    parameters=[
        Parameter(
            "amplitude",
            "1",
            scale=0.02,
            low=-0.9,
            high=0.9,
            count=lambda order: order,
            per_channel=True,
            about="Legendre terms, from the first, of the relative amplitude over gray level",
            typical=(-0.3, 0.3),
            example=-0.15,
            terms=bent_curve_terms,
        )
    ],
    formula=r"u' = u\,\Bigl[1 + \sum_{n \geq 1}\,a_n P_n(2t-1)\Bigr], \qquad t = g/256",
)
def amplitude_modulation(drive: Drive, amplitude: Tensor) -> Drive:
    """The panel's amplitude depends on the gray level.

    A liquid crystal absorbs a little as it delays, or turns the polarisation out of the analyser's direction. Bright
    and dark gray levels then reflect unlike amounts of light, and a pure phase pattern becomes a mixed one.

    References
    ----------
    Moreno et al. 2004, Modulation light efficiency of diffractive lenses displayed in a restricted phase-mostly
    modulation display, Appl. Opt. 43, 6278.

    Goodman, Introduction to Fourier Optics, chapter on wavefront modulation.
    """
    t = drive.level
    curve = 1 + amplitude @ legendre_curve(2 * t - 1, amplitude.shape[0] + 1)[1:]
    return drive.modulated(torch.clamp(curve, min=0))


@effect(
    stage="drive",
    acts_on="display",
    colours="either",
    rare=True,
    parameters=[
        Parameter(
            "real",
            "1",
            scale=0.02,
            low=-1,
            high=1,
            about="amplitude in phase with gray level 0, of the first component's",
            typical=(-0.3, 0.3),
            example=0.2,
        ),
        Parameter(
            "imaginary",
            "1",
            scale=0.02,
            low=-1,
            high=1,
            about="amplitude a quarter wave ahead",
            typical=(-0.3, 0.3),
        ),
        Parameter(
            "gain",
            "1",
            scale=0.05,
            absent=0.4,
            low=0.05,
            high=0.95,
            starts=(0.2, 0.4, 0.6, 0.8),
            about="the second component's phase over the first one's",
            typical=(0.05, 0.95),
        ),
        Parameter(
            "crossed",
            "1",
            scale=0.04,
            low=0,
            high=1,
            even=True,
            about="amplitude that is polarised across the first component, so that their irradiances add",
            typical=(0, 0.4),
        ),
    ],
    formula=(
        r"I = \bigl|\,S\,(e^{j\varphi} + p\,e^{j\gamma\varphi})\,\bigr|^2 + \bigl|\,c\,S\,e^{j\gamma\varphi}\,\bigr|^2,"
        r" \qquad p = p_\mathrm{r} + j\,p_\mathrm{i}"
    ),
)
def polarisation_leak(drive: Drive, real: Tensor, imaginary: Tensor, gain: Tensor, crossed: Tensor) -> Drive:
    """A second component of the light has a weaker phase curve of its own.

    Light that is not polarised along the liquid crystal's axis, or that the crystal turns, is delayed less by the same
    voltage. Behind an analyser it interferes with the rest; without one it adds a second, weaker picture.

    References
    ----------
    Saleh and Teich 2007, Fundamentals of Photonics, section 20.3.
    """
    one, none = torch.ones_like(real), torch.zeros_like(real)
    first = (torch.stack((one, real)), torch.stack((none, imaginary)))
    amplitudes, turns = torch.complex(*first)[None], torch.stack((none, gain - 1))[None]
    if float(crossed.detach()) == 0:
        return drive.split(amplitudes, turns, one[None])
    second = torch.complex(torch.stack((none, crossed / SELDOM**0.5)), torch.zeros(2, dtype=real.dtype))
    shares = torch.tensor((1.0, SELDOM), dtype=real.dtype)
    return drive.split(torch.cat((amplitudes, second[None])), torch.cat((turns, turns)), shares)


@effect(
    stage="drive",
    acts_on="display",
    parameters=[
        Parameter(
            "share",
            "1",
            scale=0.02,
            low=0,
            high=0.9,
            about="of the phase shown before that is still there",
            typical=(0, 0.3),
            example=0.1,
        )
    ],
    formula=r"\varphi'_k = (1-s)\,\varphi_k + s\,\varphi'_{k-1}",
)
def slow_response(drive: Drive, share: Tensor) -> Drive:
    """What the panel showed before is still there.

    The liquid crystal needs some milliseconds to turn. A capture that is taken soon after its pattern was sent still
    shows a part of the pattern before it. A pattern that stays is shown as it is.

    References
    ----------
    Thalhammer et al. 2013, Speeding up liquid crystal SLMs using overdrive with phase change reduction, Opt. Express
    21, 1779.
    """
    return replace(drive, persistence=share)


@effect(
    stage="drive",
    acts_on="display",
    parameters=[
        Parameter(
            "rms",
            "1",
            scale=0.03,
            low=0,
            high=0.6,
            even=True,
            starts=(0.03, 0.1),
            about="of the phase's gain within an exposure",
            typical=(0, 0.3),
            example=0.1,
        )
    ],
    formula=r"I = \sum_k\,w_k\,I\bigl[(1 + s_k)\,\varphi\bigr], \qquad \sum_k\,w_k s_k^2 = \sigma^2",
)
def phase_ripple(drive: Drive, rms: Tensor) -> Drive:
    """The phase's gain ripples within each exposure.

    A digital drive sends pulses, and the liquid crystal follows them a little. The camera adds up what the panel shows
    at every moment. The spread of the phase acts as incoherent light with a spectrum of the pattern's own.

    References
    ----------
    Lizana et al. 2008, Time fluctuations of the phase modulation in a liquid crystal on silicon display, Opt. Express
    16, 16711.

    García-Márquez et al. 2012, Flicker minimization in an LCoS spatial light modulator, Opt. Express 20, 8431.
    """
    swing = torch.tensor(SWING, dtype=rms.dtype)[:, None] * rms
    amplitudes = torch.complex(torch.ones_like(swing), torch.zeros_like(swing))
    return drive.split(amplitudes, swing, torch.tensor(SWING_SHARES, dtype=rms.dtype))
