"""How near a predicted picture is to the camera's: PSNR, SSIM, 1 - LPIPS, on display-encoded pictures 0 .. 1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trainer.networks.perceptual import SMALLEST, Lpips
from trainer.training.losses import picture, three_planes, where_seen
from trainer.training.pairs import Pairs


@dataclass(frozen=True)
class Likeness:
    """psnr_db : peak is white. ssim : Wang et al. 2004, Gaussian window of 1.5 pixels. one_minus_lpips : None
    without weights, or where pictures are too small for it.
    """

    psnr_db: float
    ssim: float
    one_minus_lpips: float | None

    def as_json(self) -> dict[str, Any]:
        """For `--json`."""
        return dict(vars(self))


def likeness(ours: Tensor, target: Tensor, weight: Tensor, lpips: Lpips | None = None) -> Likeness:
    """How near a picture [C, H, W] is to a target, over the pixels whose weight [C, H, W] is 1.

    A colour without such a pixel does not count. LPIPS sees the target where the weight is 0.
    """
    from skimage.metrics import structural_similarity

    ours, target = where_seen(ours, target, weight).clamp(0, 1), target.clamp(0, 1)
    mse = float((weight * (ours - target).double() ** 2).sum() / weight.sum().clamp(min=1))
    ssim = []
    for k in range(len(ours)):
        if bool(weight[k].any()):
            _, near = structural_similarity(
                ours[k].numpy(), target[k].numpy(), gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
                data_range=1.0, full=True,
            )  # fmt: skip
            ssim.append(float(np.average(near, weights=weight[k].numpy())))
    distance = None
    if lpips is not None and min(ours.shape[1:]) >= SMALLEST:
        distance = 1 - float(lpips(three_planes(ours[None]), three_planes(target[None]))[0])
    psnr = -10 * float(np.log10(max(mse, 1e-12)))
    return Likeness(psnr, float(np.mean(ssim)) if ssim else 0.0, distance)


def mean_likeness(several: list[Likeness]) -> Likeness:
    """The mean over pictures; LPIPS only where all have it."""
    distances = [one.one_minus_lpips for one in several]
    known = [d for d in distances if d is not None]
    return Likeness(
        float(np.mean([one.psnr_db for one in several])),
        float(np.mean([one.ssim for one in several])),
        float(np.mean(known)) if known and len(known) == len(several) else None,
    )


@torch.no_grad()
def evaluate(
    pairs: Pairs, network: Callable[[Tensor], Tensor] | None, lpips: Lpips | None = None
) -> Likeness:
    """Likeness of a network's predictions to the measurements, mean over pictures; None is the identity."""
    found = []
    for k in range(len(pairs)):
        given = pairs.predicted[k : k + 1]
        ours = picture(given if network is None else network(given).cpu(), pairs.white)[0]
        found.append(_likeness(pairs, k, ours, lpips))
    return mean_likeness(found)


def noise_floor(pairs: Pairs, lpips: Lpips | None = None, seed: int = 0) -> Likeness:
    """Likeness of the measurements to themselves with the camera's noise once more.

    What a perfect prediction would have: the noise added is as large as the one that is there, to first order.
    """
    generator = torch.Generator().manual_seed(seed)
    found = []
    for k in range(len(pairs)):
        noise = pairs.noise[k].clamp(min=0).sqrt() * torch.randn(pairs.noise[k].shape, generator=generator)
        found.append(_likeness(pairs, k, picture(pairs.measured[k] + noise, pairs.white), lpips))
    return mean_likeness(found)


def _likeness(pairs: Pairs, k: int, ours: Tensor, lpips: Lpips | None) -> Likeness:
    return likeness(ours, picture(pairs.measured[k], pairs.white), pairs.weight[k], lpips)
