"""Pictures sampled at a camera's places: most predictions of a fit ask for the same ones."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from runtime.camera.sampling import spline_matrix, spline_samples
from trainer.device import array_of

MOST_PLACES = 400_000  # whose weights are kept: 50 MB


def samples_at(coefficients: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """`spline_samples`; on the processor with the weights of the places kept, where nothing is differentiated.

    Parameters
    ----------
    coefficients : Tensor [B, n, m]
    y, x : Tensor [h, w], samples

    Returns
    -------
    Tensor [B, h, w]
    """
    differentiated = any(t.requires_grad for t in (coefficients, y, x))
    kept = coefficients.device.type == "cpu" and coefficients.dtype == torch.float32
    if differentiated or not kept or y.numel() > MOST_PLACES:
        return spline_samples(coefficients, y, x)
    height, width = coefficients.shape[-2:]
    places = (array_of(t.double()).tobytes() for t in (y, x))
    weights = _weights(*places, (y.shape[-2], y.shape[-1]), (height, width))
    sampled = [weights @ one.ravel() for one in array_of(coefficients)]
    return torch.from_numpy(np.stack(sampled).reshape(-1, *y.shape))


@lru_cache(maxsize=3)
def _weights(y: bytes, x: bytes, places: tuple[int, int], shape: tuple[int, int]) -> csr_matrix:
    rows, columns = (np.frombuffer(b, np.float64).reshape(places) for b in (y, x))
    return spline_matrix(rows, columns, shape)
