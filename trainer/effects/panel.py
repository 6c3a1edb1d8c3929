"""Effects of the panel: a fixed complex field that multiplies what it shows, or is added to it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from runtime.lightpath.legendre import legendre_count, legendre_surface
from trainer.effects.definition import Parameter, effect
from trainer.effects.starts import wavefront_starts
from trainer.prediction.stages import Panel


@effect(
    stage="panel",
    acts_on="display",
    orders=(0, 2, 4),
    parameters=[
        Parameter(
            "leak_real",
            "1",
            scale=0.02,
            low=-1,
            high=1,
            about="in phase with gray level 0, of the modulated amplitude",
        ),
        Parameter(
            "leak_imaginary", "1", scale=0.02, low=-1, high=1, about="a quarter wave ahead of gray level 0"
        ),
        Parameter(
            "fill_factor",
            "1",
            scale=0.03,
            absent=lambda bench: bench.panel.fill_factor,
            low=0.3,
            high=1.0,
            about="lit share of a pixel's area, which also sets the pixel's aperture",
        ),
        Parameter(
            "leak_wavefront",
            "rad",
            scale=0.1,
            low=-60,
            high=60,
            count=legendre_count,
            about="Legendre terms of the leak's phase against the modulated light's: a first surface has its own shape",
        ),
    ],
)
def zero_order(
    panel: Panel, leak_real: Tensor, leak_imaginary: Tensor, fill_factor: Tensor, leak_wavefront: Tensor
) -> Panel:
    """Light that the pattern does not modulate: dead space between pixels, first-surface reflection."""
    side = torch.sqrt(fill_factor)
    leak = panel.source * torch.complex(leak_real, leak_imaginary)
    if leak_wavefront.shape[0]:
        phase = legendre_surface(leak_wavefront, panel.y, panel.x)
        leak = leak * torch.polar(torch.ones_like(phase), phase)
    return replace(panel.leaking(leak), aperture=torch.stack((side, side)))


@effect(
    stage="panel",
    acts_on="display",
    orders=(2, 4, 6, 8),
    parameters=[
        Parameter(
            "log_amplitude",
            "1",
            scale=0.03,
            low=-4,
            high=4,
            count=legendre_count,
            about="Legendre terms of the logarithm of the beam's amplitude",
        )
    ],
)
def illumination(panel: Panel, log_amplitude: Tensor) -> Panel:
    """The beam that lights the panel is not uniform."""
    return panel.multiplied(torch.exp(legendre_surface(log_amplitude, panel.y, panel.x)))


@effect(
    stage="panel",
    acts_on="display",
    orders=(2, 4, 6, 8, 10),
    starts=wavefront_starts,
    parameters=[
        Parameter(
            "wavefront",
            "rad",
            scale=0.1,
            low=-60,
            high=60,
            count=legendre_count,
            about="Legendre terms at the first channel's wavelength; one path difference for all colours",
        )
    ],
)
def panel_wavefront(panel: Panel, wavefront: Tensor) -> Panel:
    """The beam or the panel is not flat."""
    phase = legendre_surface(wavefront, panel.y, panel.x) * (panel.reference_wavelength / panel.wavelength)
    return panel.multiplied(torch.polar(torch.ones_like(phase), phase))
