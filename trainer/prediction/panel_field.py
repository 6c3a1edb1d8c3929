"""The panel's learned field: what acts on the wave at the panel and is no named effect.

One free complex map multiplies what leaves the panel. Another is added to it, which no pattern modulates. Both are
learned from captures through the physical model (`trainer.fitting.learned_field`). Absent, they change nothing at all.
A stripe, a speck of dust or a scratch is corrected there as a wave; a network on irradiance cannot do that. The headset
needs nothing new for it, because the maps become part of its source and leak.
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
    """The panel with a learned field.

    Parameters
    ----------
    panel : Panel
    maps : mapping of str to Tensor [m, n]
        One for each of UNITS; maps coarser than the panel are interpolated. `log_amplitude` and `phase` (rad) are
        those of the factor on all light, modulated or not; `phase` is at the first channel's wavelength, one path
        difference for all colours. `added_real` and `added_imaginary` are shares of the ideal modulated amplitude.

    Returns
    -------
    Panel
    """
    shape = (panel.source.shape[-2], panel.source.shape[-1])
    log, phase, real, imaginary = (resized(maps[name], shape) for name in UNITS)
    phase = phase * (panel.reference_wavelength / panel.wavelength)
    size = torch.exp(torch.clamp(log, -4, 2))
    factor = torch.complex(size * torch.cos(phase), size * torch.sin(phase))
    return panel.multiplied(factor).leaking(torch.complex(real, imaginary))


def combined(first: Mapping[str, np.ndarray], then: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The field that equals two fields, one after the other, at the first channel's wavelength.

    Parameters
    ----------
    first, then : mapping of str to float array [m, n]
        Maps as in `with_field`.

    Returns
    -------
    dict of str to float array [m, n]
    """
    factor = np.exp(then["log_amplitude"] + 1j * then["phase"])
    added = factor * (first["added_real"] + 1j * first["added_imaginary"])
    return {
        "log_amplitude": first["log_amplitude"] + then["log_amplitude"],
        "phase": first["phase"] + then["phase"],
        "added_real": (added.real + then["added_real"]).astype(np.float32),
        "added_imaginary": (added.imag + then["added_imaginary"]).astype(np.float32),
    }


def resized(nodes: Tensor, shape: tuple[int, int]) -> Tensor:
    """A map given by nodes [m, n], linearly interpolated on a grid of `shape` whose corners are nodes."""
    if tuple(nodes.shape) == shape:
        return nodes
    whole = torch.nn.functional.interpolate(nodes[None, None], shape, mode="bilinear", align_corners=True)
    return whole[0, 0]
