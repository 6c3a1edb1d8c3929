"""How similar a picture is to a target: PSNR, SSIM and 1 - LPIPS, on display-encoded pictures 0 .. 1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trainer.device import computing_on
from trainer.networks.lpips import SMALLEST, Lpips
from trainer.training.losses import display_encoded, three_planes, where_measured
from trainer.training.training_pairs import Pairs


@dataclass(frozen=True)
class ImageMetrics:
    """Metrics of one picture, or means over pictures.

    Attributes
    ----------
    psnr_db : float, dB
        The peak is white.
    ssim : float
        With a Gaussian window of 1.5 pixels (Wang et al. 2004).
    one_minus_lpips : float or None
        None without weights, or where pictures are too small for it.
    """

    psnr_db: float
    ssim: float
    one_minus_lpips: float | None

    def as_json(self) -> dict[str, Any]:
        """Keys `psnr_db`, `ssim` and `one_minus_lpips` of `train --json`, `loop --json` and `evaluate --json`."""
        return dict(vars(self))


def image_metrics(ours: Tensor, target: Tensor, weight: Tensor, lpips: Lpips | None = None) -> ImageMetrics:
    """Metrics of a picture against a target, over the pixels whose weight is 1.

    Parameters
    ----------
    ours, target : Tensor [C, H, W]
        Display-encoded pictures.
    weight : Tensor [C, H, W]
        0 or 1. A colour without a 1 does not count; LPIPS gets the target's value where it is 0.
    lpips : Lpips or None
        None leaves 1 - LPIPS out.
    """
    from skimage.metrics import structural_similarity

    ours, target = where_measured(ours, target, weight).clamp(0, 1), target.clamp(0, 1)
    mse = float((weight * (ours - target).double() ** 2).sum() / weight.sum().clamp(min=1))
    ssim = []
    for k in range(len(ours)):
        if bool(weight[k].any()):
            _, local = structural_similarity(
                ours[k].numpy(), target[k].numpy(), gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
                data_range=1.0, full=True,
            )  # fmt: skip
            ssim.append(float(np.average(local, weights=weight[k].numpy())))
    distance = None
    if lpips is not None and min(ours.shape[1:]) >= SMALLEST:
        distance = 1 - float(lpips(three_planes(ours[None]), three_planes(target[None]))[0])
    psnr = -10 * float(np.log10(max(mse, 1e-12)))
    return ImageMetrics(psnr, float(np.mean(ssim)) if ssim else 0.0, distance)


def mean_metrics(several: list[ImageMetrics]) -> ImageMetrics:
    """The mean over pictures; LPIPS only where all have it."""
    distances = [one.one_minus_lpips for one in several]
    known = [d for d in distances if d is not None]
    return ImageMetrics(
        float(np.mean([one.psnr_db for one in several])),
        float(np.mean([one.ssim for one in several])),
        float(np.mean(known)) if known and len(known) == len(several) else None,
    )


@torch.no_grad()
def prediction_metrics(
    pairs: Pairs, network: Callable[[Tensor], Tensor] | None, lpips: Lpips | None = None
) -> ImageMetrics:
    """Metrics of a network's predictions against the measurements, mean over pictures; None is the identity."""
    found = []
    for k in range(len(pairs)):
        given = pairs.predicted[k : k + 1]
        ours = display_encoded(given if network is None else network(given).cpu(), pairs.white)[0]
        found.append(_metrics(pairs, k, ours, lpips))
    return mean_metrics(found)


@computing_on("cpu")
def noise_floor(pairs: Pairs, lpips: Lpips | None = None, seed: int = 0) -> ImageMetrics:
    """Metrics of the measurements against themselves with the camera's noise added once more.

    A perfect prediction would have these metrics: to first order, the added noise is as large as the noise in the
    measurements.
    """
    generator = torch.Generator().manual_seed(seed)
    found = []
    for k in range(len(pairs)):
        noise = pairs.noise[k].clamp(min=0).sqrt() * torch.randn(pairs.noise[k].shape, generator=generator)
        found.append(_metrics(pairs, k, display_encoded(pairs.measured[k] + noise, pairs.white), lpips))
    return mean_metrics(found)


def _metrics(pairs: Pairs, k: int, ours: Tensor, lpips: Lpips | None) -> ImageMetrics:
    return image_metrics(ours, display_encoded(pairs.measured[k], pairs.white), pairs.weight[k], lpips)
