"""Pictures carried from the camera's pixels to the panel's and back, for training.

The resampling is `runtime.camera.sampling.rectified`, in NumPy: no gradient passes through it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from runtime.camera.sampling import panel_on_camera, rectified
from trainer.captures.bench_file import Bench
from trainer.device import array_of
from trainer.prediction.scene import Scene, Stages

Places = tuple[np.ndarray, np.ndarray]


def onto_panel(scene: Scene, stages: Stages, picture: Tensor) -> Tensor:
    """A picture on the camera's pixels [h, w], resampled at the panel's [H, W]; zero where the camera does not look."""
    if _same_pixels(scene, stages):
        return picture
    y, x = first_y, first_x = _panel_on_camera(scene.bench)
    moves = _displacement(stages, picture.shape)
    if moves is not None:
        # A camera pixel looks where the one a displacement further on should; displacements vary slowly.
        for _ in range(2):
            dy, dx = (rectified(d, y, x) for d in moves)
            y, x = first_y - dy, first_x - dx
    return _resampled(picture, y, x)


def onto_camera(scene: Scene, stages: Stages, picture: Tensor) -> Tensor:
    """A picture on the panel's pixels [H, W], resampled at the camera's [h, w]; zero outside the panel."""
    if _same_pixels(scene, stages):
        return picture
    camera = scene.bench.camera
    y, x = np.indices(camera.shape, dtype=float)
    moves = _displacement(stages, camera.shape)
    if moves is not None:
        y, x = y + moves[0], x + moves[1]
    return _resampled(picture, *camera.on_panel(y, x))


def _same_pixels(scene: Scene, stages: Stages) -> bool:
    """Whether camera pixel (i, j) is panel pixel (i, j)."""
    bench = scene.bench
    aligned = bench.camera.registered and bench.camera.shape == bench.panel.shape
    return aligned and stages.sensor.displacement is None


def _displacement(stages: Stages, shape: tuple[int, ...]) -> Places | None:
    """How far from its place each camera pixel looks, camera pixels (y, x), float64 [h, w]; None: not at all."""
    given = stages.sensor.displacement
    if given is None:
        return None
    dy, dx = (np.broadcast_to(array_of(d.double()), shape) for d in given)
    return dy, dx


@lru_cache(maxsize=2)
def _panel_on_camera(bench: Bench) -> Places:
    """Where on the camera each panel pixel's centre falls, camera pixels (y, x), float64 [H, W]."""
    given = bench.camera.homography
    return panel_on_camera(np.eye(3) if given is None else np.asarray(given, float), bench.panel.shape)


def _resampled(picture: Tensor, y: np.ndarray, x: np.ndarray) -> Tensor:
    """A picture [h, w] at places in its pixels, as a tensor of its type; zero outside."""
    values = rectified(array_of(picture), y, x)
    return torch.as_tensor(values, dtype=picture.dtype, device=picture.device)
