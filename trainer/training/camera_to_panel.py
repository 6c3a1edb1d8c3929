"""Pictures carried from the camera's pixels to the panel's and back, for training."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from trainer.prediction.scene import Scene, Stages


def onto_panel(scene: Scene, stages: Stages, picture: Tensor) -> Tensor:
    """A picture on the camera's pixels [h, w], resampled at the panel's [H, W]; zero where the camera does not look."""
    if _same_pixels(scene, stages):
        return picture
    y, x = first_y, first_x = _panel_on_camera(scene)
    if stages.sensor.displacement is not None:
        moves = [d.to(picture.dtype).expand(picture.shape) for d in stages.sensor.displacement]
        # A camera pixel looks where the one a displacement further on should; displacements vary slowly.
        for _ in range(2):
            dy, dx = (_sampled(d, y, x) for d in moves)
            y, x = first_y - dy, first_x - dx
    return _sampled(picture, y, x)


def onto_camera(scene: Scene, stages: Stages, picture: Tensor) -> Tensor:
    """A picture on the panel's pixels [H, W], resampled at the camera's [h, w]; zero outside the panel."""
    if _same_pixels(scene, stages):
        return picture
    camera = scene.bench.camera
    y, x = (torch.as_tensor(a, dtype=picture.dtype) for a in np.indices(camera.shape, dtype=float))
    if stages.sensor.displacement is not None:
        y, x = y + stages.sensor.displacement[0], x + stages.sensor.displacement[1]
    return _sampled(picture, *camera.on_panel(y, x))


def _same_pixels(scene: Scene, stages: Stages) -> bool:
    """Whether camera pixel (i, j) is panel pixel (i, j)."""
    bench = scene.bench
    aligned = bench.camera.registered and bench.camera.shape == bench.panel.shape
    return aligned and stages.sensor.displacement is None


@lru_cache(maxsize=8)
def _panel_on_camera(scene: Scene) -> tuple[Tensor, Tensor]:
    """Where on the camera each panel pixel's centre falls, camera pixels (y, x), each [H, W]."""
    y, x = np.indices(scene.bench.panel.shape, dtype=float)
    given = scene.bench.camera.homography
    if given is not None:
        m = np.linalg.inv(np.asarray(given, dtype=float).reshape(3, 3))
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2]
        y, x = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / w, (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / w
    return torch.as_tensor(y, dtype=scene.dtype), torch.as_tensor(x, dtype=scene.dtype)


def _sampled(picture: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Cubic interpolation of a picture [h, w] at places in its pixels; zero outside."""
    height, width = picture.shape
    places = torch.stack((2 * x / max(width - 1, 1) - 1, 2 * y / max(height - 1, 1) - 1), -1).to(
        picture.dtype
    )
    return torch.nn.functional.grid_sample(
        picture[None, None], places[None], mode="bicubic", padding_mode="zeros", align_corners=True
    )[0, 0]
