"""The panel's learned field: what acts on the wave at the panel and has no name.

A free complex map multiplies what leaves the panel, and another is added to it that no pattern modulates. Both are
learned from captures through the physical model (`trainer.fitting.learned_field`); absent, they change nothing,
exactly. A stripe, a speck of dust or a scratch is corrected there as a wave, which no network on irradiance can do, and
the headset needs nothing new for it: the maps end in its source and leak.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from trainer.prediction.stages import Panel

UNITS = {"log_amplitude": "1", "phase": "rad", "added_real": "1", "added_imaginary": "1"}
NAME = "panel_field"


def with_field(panel: Panel, maps: Mapping[str, Tensor]) -> Panel:
    """The panel with a field, maps [m, n] of UNITS; coarser ones than the panel are interpolated.

    log_amplitude and phase are of the factor on all light, modulated or not; phase is at the first channel's
    wavelength, one path difference for all colours. added_real and added_imaginary are shares of the ideal modulated
    amplitude.
    """
    shape = (panel.source.shape[-2], panel.source.shape[-1])
    log, phase, real, imaginary = (resized(maps[name], shape) for name in UNITS)
    phase = phase * (panel.reference_wavelength / panel.wavelength)
    size = torch.exp(torch.clamp(log, -4, 2))
    factor = torch.complex(size * torch.cos(phase), size * torch.sin(phase))
    return panel.multiplied(factor).leaking(torch.complex(real, imaginary))


def combined(first: Mapping[str, np.ndarray], then: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The field that does what two do one after the other, at the first channel's wavelength."""
    factor = np.exp(then["log_amplitude"] + 1j * then["phase"])
    added = factor * (first["added_real"] + 1j * first["added_imaginary"])
    return {
        "log_amplitude": first["log_amplitude"] + then["log_amplitude"],
        "phase": first["phase"] + then["phase"],
        "added_real": (added.real + then["added_real"]).astype(np.float32),
        "added_imaginary": (added.imag + then["added_imaginary"]).astype(np.float32),
    }


def resized(nodes: Tensor, shape: tuple[int, int]) -> Tensor:
    """A map given by nodes [m, n], straight lines between them, on a grid of `shape` whose corners are nodes."""
    if tuple(nodes.shape) == shape:
        return nodes
    whole = torch.nn.functional.interpolate(nodes[None, None], shape, mode="bilinear", align_corners=True)
    return whole[0, 0]
