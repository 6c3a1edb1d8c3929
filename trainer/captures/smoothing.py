"""Pictures smoothed with a Gaussian."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d


def smoothed(pictures: Tensor, sigma_px: float) -> Tensor:
    """Pictures [B, h, w] convolved with a Gaussian; dark beyond their border.

    Parameters
    ----------
    sigma_px : float, pixels
        Standard deviation.
    """
    reach = math.ceil(3 * sigma_px)
    place = torch.arange(-reach, reach + 1, dtype=pictures.dtype)
    kernel = torch.exp(-0.5 * (place / sigma_px) ** 2)
    kernel = kernel / kernel.sum()
    along_rows = conv2d(pictures[:, None], kernel[None, None, None, :], padding=(0, reach))
    return conv2d(along_rows, kernel[None, None, :, None], padding=(reach, 0))[:, 0]
