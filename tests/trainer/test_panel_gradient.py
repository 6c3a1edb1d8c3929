"""The panel's gradients by the light path's adjoint are those of automatic differentiation, and of differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from runtime.lightpath.light_path import mode_irradiance, panel_spectrum
from tests.runtime.benches import random_path, torch_path

torch = pytest.importorskip("torch")

from trainer.prediction.panel_gradient import has_panel_gradient, image_with_panel_gradient  # noqa: E402


def parts(shape: tuple[int, int]) -> dict[str, torch.Tensor]:
    draw = np.random.default_rng(3)
    field = draw.normal(0, 1, (4, *shape))
    return {
        "source": torch.complex(torch.tensor(1 + 0.2 * field[0]), torch.tensor(0.2 * field[1])),
        "leak": torch.complex(torch.tensor(0.1 * field[2]), torch.tensor(0.1 * field[3])),
        "phase": torch.tensor(draw.normal(0, 2, (2, *shape))),
    }


@pytest.mark.parametrize("wanted", [("source",), ("leak",), ("phase",), ("source", "leak", "phase")])
def test_the_adjoint_agrees_with_automatic_differentiation(wanted: tuple[str, ...]) -> None:
    path = torch_path(random_path(crosstalk=None, modulation=None))
    values = parts(path.grid.shape)

    def gradients(by_adjoint: bool) -> list[torch.Tensor]:
        here = {n: t.detach().clone().requires_grad_(n in wanted) for n, t in values.items()}
        at = replace(path, source=here["source"], leak=here["leak"])
        assert has_panel_gradient(at, here["phase"])
        if by_adjoint:
            image = image_with_panel_gradient(at, here["phase"])
        else:
            image = mode_irradiance(at, panel_spectrum(at, here["phase"]))
        weight = torch.linspace(0.5, 2, image.numel(), dtype=image.dtype).reshape(image.shape)
        (weight * image**2).sum().backward()
        return [here[n].grad for n in wanted]

    for ours, theirs in zip(gradients(True), gradients(False), strict=True):
        assert float((ours - theirs).abs().max()) < 1e-9 * float(theirs.abs().max())


def test_gradients_behind_the_panel_are_left_to_automatic_differentiation() -> None:
    path = torch_path(random_path(crosstalk=None, modulation=None))
    phase = parts(path.grid.shape)["phase"].requires_grad_()
    assert has_panel_gradient(path, phase)
    assert not has_panel_gradient(replace(path, weights=path.weights.clone().requires_grad_()), phase)
    with torch.no_grad():
        assert not has_panel_gradient(path, phase)
