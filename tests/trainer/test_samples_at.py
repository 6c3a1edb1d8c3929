"""Pictures sampled at a camera's places by kept weights: the same sums, and their adjoint."""

from __future__ import annotations

import torch

from runtime.camera.sampling import spline_samples
from trainer.prediction.samples_at import samples_at


def test_kept_weights_give_the_same_samples_and_the_same_gradient() -> None:
    generator = torch.Generator().manual_seed(4)
    pictures = torch.randn((2, 20, 24), generator=generator, requires_grad=True)
    y, x = (torch.rand((9, 7), generator=generator) * (n + 4) - 2 for n in (20, 24))  # some fall outside
    toward = torch.randn((2, 9, 7), generator=generator)
    found, expected = samples_at(pictures, y, x), spline_samples(pictures, y, x)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    (slope,) = torch.autograd.grad((found * toward).sum(), pictures)
    (expected_slope,) = torch.autograd.grad((expected * toward).sum(), pictures)
    torch.testing.assert_close(slope, expected_slope, rtol=1e-5, atol=1e-6)


def test_places_that_move_have_gradients() -> None:
    pictures = torch.arange(400.0).reshape(1, 20, 20)
    y = torch.full((1, 1), 8.3, requires_grad=True)
    (slope,) = torch.autograd.grad(samples_at(pictures, y, torch.full((1, 1), 9.6)).sum(), y)
    torch.testing.assert_close(slope, torch.full((1, 1), 20.0))  # a row further down is 20 more
