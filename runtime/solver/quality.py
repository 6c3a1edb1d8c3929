"""How near what is shown is to what was wanted, always through the whole linear light path on the fine grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from runtime.lightpath.light_path import LightPath, irradiance, panel_phase, pixel_irradiance


@dataclass(frozen=True)
class Quality:
    """How near irradiance is to a target, up to one scale.

    psnr_db: of amplitude, the target's brightest as the peak. nrmse: root mean squared error of irradiance
    over the target's standard deviation. scale: irradiance a unit of target.
    """

    psnr_db: float
    nrmse: float
    scale: float


def shown(path: LightPath, gray: np.ndarray) -> np.ndarray:
    """What pixels of the panel's size integrate when gray levels [H, W] are shown: [H, W].

    Zero-padded so that nothing wraps around, and on a grid twice as fine as the panel's, which irradiance needs.
    """
    phase = panel_phase(path, gray.astype(np.int64))
    return pixel_irradiance(path, irradiance(path, phase))


def quality_of(
    path: LightPath, gray: np.ndarray, target: np.ndarray, region: np.ndarray | None = None
) -> Quality:
    """Quality of what gray levels [H, W] show through a path, against a target irradiance [H, W]."""
    return quality(shown(path, gray), target, region)


def quality(light: np.ndarray, target: np.ndarray, region: np.ndarray | None = None) -> Quality:
    """How near irradiance is to a target, both [H, W], each error with its own best scale.

    region: bool [H, W], the pixels that count; none: all.
    """
    if region is not None:
        light, target = light[region], target[region]
    root = np.sqrt(np.maximum(light, 0), dtype=np.float64)
    wanted = np.sqrt(target, dtype=np.float64)
    residual = root * (float(np.vdot(root, wanted)) / max(float(np.vdot(root, root)), 1e-300)) - wanted
    psnr = 20 * math.log10(wanted.max() / max(float(np.sqrt(np.mean(residual**2))), 1e-150))
    shown, asked = light.astype(np.float64), target.astype(np.float64)
    scale = float(np.vdot(shown, asked)) / max(float(np.vdot(asked, asked)), 1e-300)
    fitted = shown * (float(np.vdot(shown, asked)) / max(float(np.vdot(shown, shown)), 1e-300))
    spread = max(float(asked.std()), 1e-6 * float(asked.max()))
    return Quality(psnr, float(np.sqrt(np.mean((fitted - asked) ** 2))) / spread, scale)
