"""Gradients over the panel's side of the light path by its own adjoint, a fraction of automatic differentiation's time.

Where only what happens at the panel has a gradient (its field, what leaks, the phase), nothing needs to be recorded of
the way to the image: the adjoint goes back in one pass.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from runtime.lightpath.host_arrays import unit_phasor
from runtime.lightpath.light_path import LightPath
from runtime.lightpath.light_path_adjoint import irradiance_and_field_pullback


def has_panel_gradient(path: LightPath, phase: Tensor) -> bool:
    """Whether a gradient is asked for, and of the panel's side alone."""
    if not torch.is_grad_enabled() or path.crosstalk is not None or path.modulation is not None:
        return False
    behind = (path.transfers, path.weights, *path.aperture)
    if any(isinstance(t, Tensor) and t.requires_grad for t in behind) or path.far_field is not None:
        return False
    return any(isinstance(t, Tensor) and t.requires_grad for t in (path.source, path.leak, phase))


def image_with_panel_gradient(path: LightPath, phase: Tensor) -> Tensor:
    """Irradiance before filters of a phase [B, H, W], with gradients over `source`, `leak` and the phase."""
    image: Tensor = _Image.apply(path.source, path.leak, phase, path)
    return image


class _Image(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, source: Tensor, leak: Tensor | None, phase: Tensor, path: LightPath) -> Tensor:
        here = replace(path, source=source.detach(), leak=None if leak is None else leak.detach())
        image, ctx.pullback = irradiance_and_field_pullback(here, phase.detach())
        ctx.save_for_backward(source, phase)
        return image

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None, None]:
        source, phase = ctx.saved_tensors
        needs_source, needs_leak, needs_phase, _ = ctx.needs_input_grad
        with torch.no_grad():
            over_field = ctx.pullback(gradient)
            turned = unit_phasor(-phase) * over_field
            over_source = turned.sum(0) if needs_source else None
            over_leak = over_field.sum(0) if needs_leak else None
            # d(source exp(j phi)) = j source exp(j phi) dphi.
            over_phase = (torch.conj(source) * turned).imag if needs_phase else None
        return over_source, over_leak, over_phase, None
