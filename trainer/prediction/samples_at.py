"""Pictures sampled at a camera's places: most predictions of a fit ask for the same ones."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from runtime.camera.sampling import spline_matrix, spline_samples
from trainer.device import array_of
from trainer.kept_results import kept_for_same

MOST_PLACES = 400_000  # whose weights are kept: 50 MB


def samples_at(coefficients: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """`spline_samples`; on the processor with the weights of the places kept, where these are not differentiated.

    Parameters
    ----------
    coefficients : Tensor [B, n, m]
    y, x : Tensor [h, w], samples

    Returns
    -------
    Tensor [B, h, w]
    """
    kept = coefficients.device.type == "cpu" and coefficients.dtype == torch.float32
    if y.requires_grad or x.requires_grad or not kept or y.numel() > MOST_PLACES:
        return spline_samples(coefficients, y, x)
    with torch.no_grad():
        weights = _weights_at(y, x, *coefficients.shape[-2:])
    return _Weighted.apply(coefficients, weights, tuple(y.shape))


class _Weighted(torch.autograd.Function):
    """Sums of each picture's samples by a matrix of weights, and their adjoint."""

    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, weights: csr_matrix, places: tuple[int, int]) -> Tensor:
        ctx.weights, ctx.shape = weights, coefficients.shape
        return _each(weights, coefficients, places)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _each(ctx.weights.T, gradient, ctx.shape[-2:]), None, None


def _each(weights: csr_matrix, pictures: Tensor, shape: tuple[int, int]) -> Tensor:
    summed = [weights @ one.ravel() for one in array_of(pictures)]
    return torch.from_numpy(np.stack(summed).reshape(-1, *shape))


@kept_for_same(3)  # the same tensors are asked for again and again, and others with the same places
def _weights_at(y: Tensor, x: Tensor, height: int, width: int) -> csr_matrix:
    places = (array_of(t.double()).tobytes() for t in (y, x))
    return _weights(*places, (y.shape[-2], y.shape[-1]), (height, width))


@lru_cache(maxsize=3)
def _weights(y: bytes, x: bytes, places: tuple[int, int], shape: tuple[int, int]) -> csr_matrix:
    rows, columns = (np.frombuffer(b, np.float64).reshape(places) for b in (y, x))
    return spline_matrix(rows, columns, shape)
