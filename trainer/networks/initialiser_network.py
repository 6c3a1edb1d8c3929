"""The network that proposes the solver's first phase, from the amplitude of the target.

It gives the panel's phase as cosine and sine. As in double phase (Hsueh and Sawchuk 1978), neighbouring pixels on a
chequerboard differ from a mean phase by an angle of opposite sign. The network gives the mean phase and a correction of
the angle, which starts as the arc cosine of the amplitude. It is local: it does not know of light that comes from
outside its field of view.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trainer.networks.onnx_files import onnx_bytes

PATCH, WIDE = 4, 32
BRIGHT = 2.5  # amplitude, of mean square 1, that a pixel reaches with all of its light


class InitialiserNetwork(nn.Module):
    """Amplitude [B, 1, H, W] to the cosine and sine [B, 2, H, W] of a phase; H and W are multiples of 4."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(1, WIDE, PATCH, PATCH)
        self.inner = nn.ModuleList(
            nn.Conv2d(WIDE, WIDE, 3, padding=dilation, dilation=dilation) for dilation in (1, 2, 4, 8)
        )
        self.last = nn.ConvTranspose2d(WIDE, 2, PATCH, PATCH)
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)

    def forward(self, amplitude: Tensor) -> Tensor:
        x = torch.relu(self.first(amplitude))
        for layer in self.inner:
            x = x + torch.relu(layer(x))
        mean, correction = self.last(x).split(1, 1)
        share = 0.999 - torch.relu(0.999 - amplitude / BRIGHT)
        angle = torch.acos(share) + correction
        phase = mean + _chequer(amplitude) * angle
        return torch.cat((torch.cos(phase), torch.sin(phase)), 1)


def initialiser_onnx(network: InitialiserNetwork, shape: tuple[int, int]) -> bytes:
    """initialiser.onnx for a panel."""
    return onnx_bytes(network.eval(), (torch.ones(1, 1, *shape),), ["target"], ["phase"])


def _chequer(like: Tensor) -> Tensor:
    """1 and -1 on a chequerboard, [1, 1, H, W]; the runtime's double phase has the same signs at the same pixels."""
    height, width = like.shape[-2:]
    odd = (torch.arange(height)[:, None] + torch.arange(width)[None, :]) % 2
    return (1 - 2 * odd).to(like.dtype)[None, None]
