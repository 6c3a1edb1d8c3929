"""Effects of the panel: a fixed complex field that multiplies what it shows, or is added to it."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from runtime.lightpath.legendre import legendre_count, legendre_surface
from trainer.effects.definition import Parameter, effect
from trainer.effects.free_form import FreeForm
from trainer.effects.starts import coherent_ghost_starts, wavefront_starts
from trainer.effects.term_names import surface_terms
from trainer.prediction.stages import Panel

BRIGHTEST = 12.0  # logarithm of the amplitude: brighter than any beam, and counts of single precision hold it


@effect(
    stage="panel",
    acts_on="display",
    colours="either",
    orders=(0, 2, 4),
    parameters=[
        Parameter(
            "leak_real",
            "1",
            scale=0.02,
            low=-1,
            high=1,
            about="in phase with gray level 0, of the modulated amplitude",
            typical=(-0.3, 0.3),
            example=0.1,
        ),
        Parameter(
            "leak_imaginary",
            "1",
            scale=0.02,
            low=-1,
            high=1,
            about="a quarter wave ahead of gray level 0",
            typical=(-0.3, 0.3),
        ),
        Parameter(
            "fill_factor",
            "1",
            scale=0.03,
            absent=lambda bench: bench.panel.fill_factor,
            low=0.3,
            high=1.0,
            about="lit share of a pixel's area, which also sets the pixel's aperture",
            typical=(0.5, 1.0),
        ),
        Parameter(
            "leak_wavefront",
            "rad",
            scale=0.1,
            low=-60,
            high=60,
            count=legendre_count,
            about="Legendre terms of the leak's phase against the modulated light's: a first surface has its own shape",
            typical=(-10, 10),
            terms=surface_terms,
        ),
        Parameter(
            "flat_leak",
            "1",
            scale=0.02,
            low=-1,
            high=1,
            count=lambda order: 2 if order else 0,
            about="a second leak that is flat whatever the panel's wavefront, of the beam's amplitude",
            typical=(-0.3, 0.3),
            terms=lambda order: ("real", "imaginary") if order else (),
        ),
    ],
    formula=(
        r"u = S\,e^{j\varphi} * \mathrm{rect}_{\sqrt{F}} + \ell\,S\,e^{j\psi(x,y)} + f\,|S|, \qquad"
        r" \ell = \ell_\mathrm{r} + j\,\ell_\mathrm{i}"
    ),
)
def zero_order(
    panel: Panel,
    leak_real: Tensor,
    leak_imaginary: Tensor,
    fill_factor: Tensor,
    leak_wavefront: Tensor,
    flat_leak: Tensor,
) -> Panel:
    """Light that the pattern does not modulate: dead space between pixels, first-surface reflection.

    Dead space between the pixels and the panel's first surface reflect light that no pattern reaches. It crosses
    the picture as a plane wave and interferes with it. Dead space has the panel's own wavefront; the first surface of a
    panel that is bent inside may be flat.

    References
    ----------
    Chakravarthula et al. 2020, Learned hardware-in-the-loop phase retrieval for holographic near-eye displays, ACM
    Trans. Graph. 39, 186, supplement, eq. 9 to 11.
    """
    side = torch.sqrt(fill_factor)
    leak = panel.source * torch.complex(leak_real, leak_imaginary)
    if leak_wavefront.shape[0]:
        phase = legendre_surface(leak_wavefront, panel.y, panel.x)
        leak = leak * torch.polar(torch.ones_like(phase), phase)
    if flat_leak.shape[0]:
        panel = panel.reflecting(panel.source.abs() * torch.complex(flat_leak[0], flat_leak[1]))
    return replace(panel.leaking(leak), aperture=torch.stack((side, side)))


def _brightened(panel: Panel, log_amplitude: Tensor) -> Panel:
    return panel.multiplied(torch.exp(torch.clamp(log_amplitude, max=BRIGHTEST)))


@effect(
    stage="panel",
    acts_on="display",
    colours="either",
    orders=(2, 4, 6, 8),
    free_form=FreeForm(_brightened, "1", 0.05),
    parameters=[
        Parameter(
            "log_amplitude",
            "1",
            scale=0.03,
            low=-12,  # a beam that is dark in the corners
            high=12,
            count=legendre_count,
            about="Legendre terms of the logarithm of the beam's amplitude",
            typical=(-0.8, 0.8),
            example=(0.0, 0.0, -0.3, 0.0, -0.3),
            terms=surface_terms,
        )
    ],
    formula=r"u' = u\,\exp\Bigl[\sum_{i,j}\,a_{ij}\,P_i(y)\,P_j(x)\Bigr]",
)
def illumination(panel: Panel, log_amplitude: Tensor) -> Panel:
    """The beam that lights the panel is not uniform.

    A laser beam is brighter in its middle than at its edge, and it may be off centre. The model takes it as
    uniform.

    References
    ----------
    Čižmár et al. 2010, In situ wavefront correction and its application to micromanipulation, Nat. Photonics 4,
    388.
    """
    return _brightened(panel, legendre_surface(log_amplitude, panel.y, panel.x))


def _delayed(panel: Panel, wavefront: Tensor) -> Panel:
    phase = wavefront * (panel.reference_wavelength / panel.wavelength)
    return panel.multiplied(torch.polar(torch.ones_like(phase), phase))


@effect(
    stage="panel",
    acts_on="display",
    colours="either",
    orders=(2, 4, 6, 8, 10),
    starts=wavefront_starts,
    free_form=FreeForm(_delayed, "rad", 0.1),
    parameters=[
        Parameter(
            "wavefront",
            "rad",
            scale=0.1,
            low=-60,
            high=60,
            count=legendre_count,
            about="Legendre terms at the first channel's wavelength; one path difference for all colours",
            typical=(-10, 10),
            example=(0.0, 0.0, 2.0),
            terms=surface_terms,
        )
    ],
    formula=r"u' = u\,\exp\Bigl[\,j\,\dfrac{\lambda_1}{\lambda} \sum_{i,j}\,w_{ij}\,P_i(y)\,P_j(x)\Bigr]",
)
def panel_wavefront(panel: Panel, wavefront: Tensor) -> Panel:
    """The beam or the panel is not flat.

    The panel's cover glass and backplane bend, and the beam that lights it is not quite collimated. Tilts move the
    picture, curvature defocuses it, and higher terms distort it.

    References
    ----------
    Čižmár et al. 2010, In situ wavefront correction and its application to micromanipulation, Nat. Photonics 4,
    388.
    """
    return _delayed(panel, legendre_surface(wavefront, panel.y, panel.x))


@effect(
    stage="panel",
    acts_on="display",
    colours="either",
    starts=coherent_ghost_starts,
    parameters=[
        Parameter(
            "real",
            "1",
            scale=0.01,
            low=-1,
            high=1,
            about="amplitude of the copy in phase with the light itself",
            typical=(-0.3, 0.3),
            example=0.15,
        ),
        Parameter(
            "imaginary",
            "1",
            scale=0.01,
            low=-1,
            high=1,
            about="amplitude a quarter wave ahead",
            typical=(-0.3, 0.3),
        ),
        Parameter("shift_y", "pixels", scale=0.2, low=-200, high=200, typical=(-30, 30), example=3.0),
        Parameter("shift_x", "pixels", scale=0.2, low=-200, high=200, typical=(-30, 30), example=6.0),
        Parameter(
            "path_difference",
            "nm",
            scale=10.0,
            low=-1e5,
            high=1e5,
            about="turns the copy's phase from colour to colour, from the first on; nothing in one colour",
            typical=(-1000, 1000),
        ),
    ],
    formula=(
        r"u'(\mathbf{r}) = u(\mathbf{r}) + (a_\mathrm{r} + j\,a_\mathrm{i})\,"
        r"\exp\Bigl[2\pi j\,\Delta\Bigl(\dfrac{1}{\lambda} - \dfrac{1}{\lambda_1}\Bigr)\Bigr]\,"
        r"u(\mathbf{r} - \mathbf{s})"
    ),
)
def coherent_ghost(
    panel: Panel, real: Tensor, imaginary: Tensor, shift_y: Tensor, shift_x: Tensor, path_difference: Tensor
) -> Panel:
    """A second path of the light, displaced and delayed, interferes with the first.

    Light that is reflected twice inside a thin window arrives displaced and a little later, within the laser's
    coherence. It interferes with the light itself: fringes that move with the pattern.

    References
    ----------
    Born and Wolf 1999, Principles of Optics, section 7.6.
    """
    waves = 1e-9 * path_difference * (1 / panel.wavelength - 1 / panel.reference_wavelength)
    turned = torch.complex(real, imaginary) * torch.polar(torch.ones_like(waves), 2 * math.pi * waves)
    return panel.copied(turned, shift_y, shift_x)
