"""Free-form maps: how an effect's map goes on where its polynomials end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from runtime.lightpath.spline_maps import node_weights, weights_at
from trainer.prediction.free_stages import PUPIL_EXTENT
from trainer.prediction.stages import Pupil


@dataclass(frozen=True)
class FreeForm:
    """A bicubic spline that is added to an effect's polynomials.

    Attributes
    ----------
    apply : callable
        `(stage, surface) -> stage`, with the surface over the stage's own grid, in `unit`.
    unit : str
    scale : float
        A node of this size is small but visible; fits step in units of it.
    """

    apply: Callable[[Any, Tensor], Any]
    unit: str
    scale: float


def surface_over(stage: Any, nodes: Tensor) -> Tensor:
    """The surface of a spline's nodes [m, n] over a stage's grid: the panel, the camera's picture or the band."""
    rows, columns = _weights(stage, (nodes.shape[0], nodes.shape[1]))
    return rows.to(nodes.dtype) @ nodes @ columns.to(nodes.dtype).T


def grid_of(stage: Any) -> tuple[int, int]:
    """Samples (rows, columns) of the grid that a stage's map lies on."""
    if isinstance(stage, Pupil):
        return stage.v.shape[0], stage.u.shape[1]
    return stage.y.shape[0], stage.y.shape[1]


def _weights(stage: Any, nodes: tuple[int, int]) -> tuple[Tensor, Tensor]:
    if isinstance(stage, Pupil):
        places = (stage.v[:, 0], stage.u[0, :])
        rows, columns = (
            _over_band(p.double().numpy().tobytes(), n) for p, n in zip(places, nodes, strict=True)
        )
    else:
        rows, columns = (_over_pixels(p, n) for p, n in zip(grid_of(stage), nodes, strict=True))
    return rows, columns


@lru_cache(maxsize=32)
def _over_pixels(pixels: int, nodes: int) -> Tensor:
    return torch.as_tensor(node_weights(pixels, nodes), dtype=torch.float64)


@lru_cache(maxsize=32)
def _over_band(frequencies: bytes, nodes: int) -> Tensor:
    places = np.frombuffer(frequencies, np.float64)
    return torch.as_tensor(weights_at(places, -PUPIL_EXTENT, PUPIL_EXTENT, nodes), dtype=torch.float64)
