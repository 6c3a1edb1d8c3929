"""The network that proposes the solver's first phase: double phase, and a correction of it.

Double phase (Hsueh and Sawchuk 1978) knows the amplitude of the target, not what the iris and the panel's end take
away. The network sees both and adds what the solver's first iterations would find. It is local: it does not know of
light that comes from outside its field of view.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trainer.networks.onnx_files import onnx_bytes

PATCH, WIDE = 4, 32


class InitialiserNetwork(nn.Module):
    """Amplitude and start (rad), [B, 1, H, W], to the cosine and sine [B, 2, H, W] of a phase; H, W: multiples of 4."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, WIDE, PATCH, PATCH)
        self.inner = nn.ModuleList(
            nn.Conv2d(WIDE, WIDE, 3, padding=dilation, dilation=dilation) for dilation in (1, 2, 4, 8)
        )
        self.last = nn.ConvTranspose2d(WIDE, 1, PATCH, PATCH)
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)

    def forward(self, amplitude: Tensor, start: Tensor) -> Tensor:
        x = torch.relu(self.first(torch.cat((amplitude, torch.cos(start), torch.sin(start)), 1)))
        for layer in self.inner:
            x = x + torch.relu(layer(x))
        phase = start + self.last(x)
        return torch.cat((torch.cos(phase), torch.sin(phase)), 1)


def initialiser_onnx(network: InitialiserNetwork, shape: tuple[int, int]) -> bytes:
    """initialiser.onnx for a panel."""
    given = torch.ones(1, 1, *shape)
    return onnx_bytes(network.eval(), (given, given.clone()), ["target", "start"], ["phase"])
