"""The compact network: small enough for the headset's loop.

Colours are shown one after another and their light does not mix, so each has its own weights (groups). Faults at fixed
places (dust, fringes, seams) are a map of gain and offset over the panel's picture. Faults that are the same everywhere
(blur, ghosts) are a convolution, here of whole patches at a time.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.networks.layers import LeakyReLU, cropped, padded

SLOPE = 0.02


class CompactNetwork(nn.Module):
    """Gain and offset maps plus patch convolutions: irradiance [B, C, H, W] to its change, same shape.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the panel; torch refuses irradiance of another size.
    filters : int
        Channels between the patches, for each colour; 0 leaves the convolutions out.
    planes : int
        Colours C.
    cell : int, pixels
        Side of a cell of the maps; 0 leaves the maps out.
    patch : int, pixels
        Side of a patch.
    """

    def __init__(
        self, shape: tuple[int, int], filters: int = 8, planes: int = 3, cell: int = 2, patch: int = 4
    ) -> None:
        super().__init__()
        self.shape, self.patch, self.cell = shape, patch, cell
        if cell:
            cells = [-(-n // cell) for n in shape]
            self.maps = nn.Parameter(torch.zeros(2, planes, *cells))
        if filters:
            wide = planes * filters
            self.first = nn.Conv2d(planes, wide, patch, patch, groups=planes)
            self.inner = nn.Sequential(
                LeakyReLU(SLOPE),
                nn.Conv2d(wide, wide, 3, 1, 1, groups=planes),
                LeakyReLU(SLOPE),
                nn.Conv2d(wide, wide, 3, 1, 1, groups=planes),
                LeakyReLU(SLOPE),
            )
            self.last = nn.ConvTranspose2d(wide, planes, patch, patch, groups=planes)

    def forward(self, x: Tensor) -> Tensor:
        change = torch.zeros_like(x)
        if hasattr(self, "first"):
            change = cropped(self.last(self.inner(self.first(padded(x, self.patch)))), x)
        if self.cell:
            gain, offset = self.maps_at_pixels()
            change = change + x * gain + offset
        return change

    def maps_at_pixels(self) -> Tensor:
        """Gain and offset at every pixel, [2, C, H, W], linear between the cells' centres."""
        if self.cell == 1:
            return self.maps
        size = [n * self.cell for n in self.maps.shape[2:]]
        fields = functional.interpolate(self.maps, size=size, mode="bilinear", align_corners=False)
        return fields[:, :, : self.shape[0], : self.shape[1]]
