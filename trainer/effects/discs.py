"""Small discs on a map, such as dust: what passes each, with edges that are smooth over one pixel."""

from __future__ import annotations

import math

import torch
from torch import Tensor

ROOM = 2.0  # pixels around a disc that are computed with it


def discs(y: Tensor, x: Tensor, row: Tensor, column: Tensor, radius: Tensor, inside: Tensor) -> Tensor:
    """The product of discs' factors: 1 outside all of them.

    A pixel on an edge is covered by the share of its width that lies inside the circle, so places and radii of less
    than a pixel have derivatives.

    Parameters
    ----------
    y, x : Tensor [H, W], pixels
        Places; one row's y are equal, and neighbours are one pixel apart.
    row, column, radius : Tensor [n], pixels
        Of the discs, in the same coordinates.
    inside : Tensor [] or [n], real or complex
        Factor within each disc.

    Returns
    -------
    Tensor [H, W]
    """
    height, width = y.shape
    each = inside.expand(row.shape)
    whole = torch.ones((height, width), dtype=inside.dtype)
    top, left = float(y[0, 0]), float(x[0, 0])
    for k in range(row.shape[0]):
        reach = float(radius[k].detach()) + ROOM
        rows = _window(float(row[k].detach()) - top, reach, height)
        columns = _window(float(column[k].detach()) - left, reach, width)
        if rows.start >= rows.stop or columns.start >= columns.stop:
            continue
        square = (y[rows, columns] - row[k]) ** 2 + (x[rows, columns] - column[k]) ** 2
        covered = torch.clamp(radius[k] + 0.5 - torch.sqrt(square + 1e-6), 0, 1)
        before = whole[rows, columns].clone()  # a view would be changed before its derivative is taken
        whole[rows, columns] = before * (1 + covered * (each[k] - 1))
    return whole


def _window(middle: float, reach: float, size: int) -> slice:
    """The pixels within reach of a place."""
    return slice(max(0, math.floor(middle - reach)), min(size, math.ceil(middle + reach) + 1))
