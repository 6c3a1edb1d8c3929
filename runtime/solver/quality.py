"""How near what is shown is to its target, always through the whole linear light path on the fine grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runtime.lightpath.light_path import LightPath, irradiance, panel_phase, pixel_irradiance
from runtime.networks.onnx_approximator import Approximator


@dataclass(frozen=True)
class Quality:
    """How near irradiance is to a target, up to one scale.

    Attributes
    ----------
    psnr_db : float, dB
        Of amplitude, the target's brightest as the peak.
    nrmse : float
        Root mean squared error of irradiance over the target's standard deviation.
    scale : float
        Irradiance a unit of target.
    """

    psnr_db: float
    nrmse: float
    scale: float


def shown(path: LightPath, gray: np.ndarray) -> np.ndarray:
    """What pixels of the panel's size integrate when gray levels [H, W] are shown: [H, W].

    Zero-padded so that nothing wraps around, and on a grid finer than the panel's, which irradiance needs.
    """
    phase = panel_phase(path, gray.astype(np.int64))
    return pixel_irradiance(path, irradiance(path, phase))


def quality_of(
    path: LightPath, gray: np.ndarray, target: np.ndarray, region: np.ndarray | None = None
) -> Quality:
    """Quality of what gray levels [H, W] show through a path, against a target irradiance [H, W]."""
    return quality(shown(path, gray), target, region)


def quality(light: np.ndarray, target: np.ndarray, region: np.ndarray | None = None) -> Quality:
    """How near irradiance is to a target, each error with its own best scale.

    Parameters
    ----------
    light, target : float array [H, W]
        Irradiance.
    region : bool array [H, W] or None
        The pixels that count; None: all.

    Returns
    -------
    Quality
    """
    if region is not None:
        light, target = light[region], target[region]
    root = np.sqrt(np.maximum(light, 0), dtype=np.float64)
    wanted = np.sqrt(target, dtype=np.float64)
    residual = root * (float(np.vdot(root, wanted)) / max(float(np.vdot(root, root)), 1e-300)) - wanted
    psnr = 20 * math.log10(wanted.max() / max(float(np.sqrt(np.mean(residual**2))), 1e-150))
    given, asked = light.astype(np.float64), target.astype(np.float64)
    scale = float(np.vdot(given, asked)) / max(float(np.vdot(asked, asked)), 1e-300)
    fitted = given * (float(np.vdot(given, asked)) / max(float(np.vdot(given, given)), 1e-300))
    spread = max(float(asked.std()), 1e-6 * float(asked.max()))
    return Quality(psnr, float(np.sqrt(np.mean((fitted - asked) ** 2))) / spread, scale)


def qualities_of(
    stacks: Sequence[Sequence[LightPath]],
    patterns: np.ndarray,
    targets: np.ndarray,
    weight: np.ndarray | None,
    approximator: Approximator | None,
) -> tuple[Quality, ...]:
    """Qualities of patterns, a colour and plane each.

    Parameters
    ----------
    stacks : list of list of LightPath
        Colours of planes.
    patterns : uint8 array [C, N, H, W]
        Gray levels; the irradiances of a colour's N patterns add.
    targets : float array [C, K, H, W]
        Irradiance.
    weight : float array [H, W] or None
        The pixels above zero count; None: all.
    approximator : Approximator or None
        Corrects the light of the first plane; its arrays are written again.

    Returns
    -------
    tuple of Quality
        Planes of the first colour first.
    """
    light = np.stack(
        [[shown(path, gray).mean(0) for path in stack] for stack, gray in zip(stacks, patterns, strict=True)]
    )
    if approximator is not None:
        for c in range(len(light)):
            approximator.irradiance[c] = light[c, 0] / light[c, 0].mean()
        approximator.correct()
        light[:, 0] = approximator.corrected
    region = None if weight is None else weight > 0
    shape = patterns.shape[2:]
    pairs = zip(light.reshape(-1, *shape), targets.reshape(-1, *shape), strict=True)
    return tuple(quality(one, target, region) for one, target in pairs)
