"""Free form: how an effect's map or curve goes on where its polynomials end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from runtime.lightpath.spline_maps import node_weights, weights_at
from trainer.device import array_of
from trainer.kept_results import kept_by_device
from trainer.prediction.free_stages import PUPIL_EXTENT
from trainer.prediction.stages import Pupil

SAMPLES = 2049  # of a curve between 0 and 1; straight lines join them


@dataclass(frozen=True)
class FreeForm:
    """A cubic spline that is added to an effect's polynomials: over a map, or along a curve.

    Attributes
    ----------
    apply : callable
        `(stage, values) -> stage`. Values, in `unit`: of a map over the stage's own grid, or SAMPLES of a curve evenly
        from 0 to 1 (`along` reads between them).
    unit : str
    scale : float
        A node of this size is small but visible; fits step in units of it.
    curve : bool
        Along a share from 0 to 1, of the gray levels or of full scale, and 0 at its beginning.
    """

    apply: Callable[[Any, Tensor], Any]
    unit: str
    scale: float
    curve: bool = False

    def added(self, stage: Any, nodes: Tensor, colour: int) -> Any:
        """The stage with what the nodes make: a map's [m, n], or [colours, m, n]; a curve's [1 or colours, n]."""
        if not self.curve:
            return self.apply(stage, surface_over(stage, nodes[colour] if nodes.ndim == 3 else nodes))
        row = nodes[colour if nodes.shape[0] > 1 else 0]
        values = _over_pixels(SAMPLES, nodes.shape[1]).to(nodes.dtype) @ row
        return self.apply(stage, values - values[0])

    @property
    def form(self) -> str:
        """ "map" or "curve"."""
        return "curve" if self.curve else "map"


def along(curve: Tensor, share: Tensor) -> Tensor:
    """A curve's values at shares; beyond 0 and 1 those of its ends."""
    place = torch.clamp(share, 0, 1) * (SAMPLES - 1)
    below = torch.clamp(place.detach().long(), max=SAMPLES - 2)
    return curve[below] + (place - below) * (curve[below + 1] - curve[below])


def on_other_curve_nodes(nodes: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """The `count` nodes a row that give nearly the same curves as nodes [curves, n]."""
    there, here = (array_of(_over_pixels(SAMPLES, n)) for n in (count, nodes.shape[1]))
    return np.asarray(nodes @ np.linalg.lstsq(there, here, rcond=None)[0].T)


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
            _over_band(array_of(p.double()).tobytes(), n) for p, n in zip(places, nodes, strict=True)
        )
    else:
        rows, columns = (_over_pixels(p, n) for p, n in zip(grid_of(stage), nodes, strict=True))
    return rows, columns


@kept_by_device(32)
def _over_pixels(pixels: int, nodes: int) -> Tensor:
    return torch.as_tensor(node_weights(pixels, nodes), dtype=torch.float64)


@kept_by_device(32)
def _over_band(frequencies: bytes, nodes: int) -> Tensor:
    places = np.frombuffer(frequencies, np.float64)
    return torch.as_tensor(weights_at(places, -PUPIL_EXTENT, PUPIL_EXTENT, nodes), dtype=torch.float64)
