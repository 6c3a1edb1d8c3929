"""Spectra of the light that leaves the panel: in each of its states, and for each wavelength of the source.

A delay of the panel is more phase at a shorter wavelength. The field is a smooth function of how much the phase is
scaled, so a parabola through three scales stands for all lines of a source: of two lines 15 nm apart the one that sees
the panel's nominal phase leaves 0.002 of the signal's variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from runtime.lightpath.light_path import (
    LightPath,
    image_field,
    mode_irradiance,
    panel_spectrum,
    states,
    sum_modes,
)

SCALE = 0.04  # by which the phase is scaled down and up: of lines 40 nm apart the parabola errs by 1e-4 of the field
NOMINAL, BESIDE = (1.0,), (1 - SCALE, 1 + SCALE)


def panel_spectra(path: LightPath, phase: Tensor, scales: Sequence[float]) -> Tensor:
    """Spectra of a phase (rad) [B, H, W], scaled.

    Parameters
    ----------
    scales : sequence of float
        `NOMINAL`, or `BESIDE` for those beside it that lines of another wavelength need, too.

    Returns
    -------
    complex Tensor [B, states, scales, n, m]
    """
    found = []
    for state in states(path):
        found.append(_stacked([panel_spectrum(_driven(state, s), s * phase) for s in scales]))
    return _stacked(found)


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    """Parts [B, ...] along a further axis after the first, a single one without a copy: it may be 100 MB."""
    return parts[0][:, None] if len(parts) == 1 else torch.stack(list(parts), 1)


def _driven(path: LightPath, scale: float) -> LightPath:
    """The path at a scaled phase: what a pixel absorbs depends on the phase that it is driven to, before the scale."""
    if path.modulation is None or path.modulation_by_phase or scale == 1:
        return path
    return replace(path, gain=torch.tensor(scale) if path.gain is None else scale * path.gain)


def irradiance_of(path: LightPath, spectra: Tensor, scales: Tensor | None) -> Tensor:
    """Irradiance of the source's lines, of all states, before filters.

    Parameters
    ----------
    spectra : complex Tensor [B, states, 1 or 3, n, m]
        Those of `NOMINAL`, or of `NOMINAL` and `BESIDE`.
    scales : Tensor [M] or None
        Of the panel's phase, for each mode of the pupil; None: 1.
    """
    parts = []
    for k, state in enumerate(states(path)):
        here = spectra[:, k]
        if scales is None:
            parts.append(mode_irradiance(state, here[:, 0]))
        else:
            fields = (image_field(state, _at(here, scale), mode) for mode, scale in enumerate(scales))
            parts.append(sum_modes(state, fields))
    return parts[0] if len(parts) == 1 else torch.stack(parts).sum(0)


def _at(spectra: Tensor, scale: Tensor) -> Tensor:
    """The spectrum of a scaled phase, on the parabola through three."""
    own, down, up = spectra.unbind(1)
    if not scale.requires_grad and scale == 1:
        return own
    place = (scale - 1) / SCALE
    return (1 - place**2) * own + 0.5 * place * ((place - 1) * down + (place + 1) * up)
