"""ONNX: onnxruntime alone gives what torch gives, as near to double precision as torch's own single is."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import onnxruntime
import pytest
import safetensors.numpy
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import ADAPTERS, APPROXIMATOR, GRADIENT
from tests.trainer.test_networks import disturbed
from trainer.networks.approximator import Approximator, penalty
from trainer.networks.onnx_files import onnx_files

ROUNDING = 2e-6  # relative, in the L2 norm: single precision, summed over a picture


def run(model: bytes, given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(None, given), strict=True))


def by_torch(
    network: Approximator, irradiance: Tensor, target: Tensor, kind: torch.dtype
) -> dict[str, Tensor]:
    """What the two files give, by torch's own derivatives in a precision."""
    one = Approximator(network.architecture)
    one.load_state_dict(network.state_dict())
    one = one.to(kind).eval()
    x, adapters = irradiance.to(kind).requires_grad_(True), one.adapters()
    corrected = one(x)
    loss = penalty(corrected, target.to(kind))
    gradients = torch.autograd.grad(loss, [x, *adapters.values()])
    names = ["gradient", *(f"gradient.{name}" for name in adapters)]
    found = {"corrected": corrected, "loss": loss, **dict(zip(names, gradients, strict=True))}
    return {name: value.detach().double() for name, value in found.items()}


def far(a: Tensor | np.ndarray, b: Tensor) -> float:
    return float((torch.as_tensor(a).double() - b).norm() / b.norm())


@lru_cache(maxsize=1)
def exported(network: str, shape: tuple[int, int], filters: int) -> dict[str, bytes]:
    return onnx_files(disturbed(network, shape, filters))


def check_parity(name: str, shape: tuple[int, int], filters: int = 4) -> None:
    """Each output is within a few times torch's own single-precision error of double precision."""
    network = disturbed(name, shape, filters)
    generator = torch.Generator().manual_seed(1)
    irradiance, target = (torch.rand(1, 3, *shape, generator=generator) * 2 for _ in range(2))
    files = exported(name, shape, filters)
    adapters = safetensors.numpy.load(files[ADAPTERS])
    found = run(files[APPROXIMATOR], {"irradiance": irradiance.numpy()})
    found |= run(files[GRADIENT], {"irradiance": irradiance.numpy(), "target": target.numpy(), **adapters})
    double, single = (by_torch(network, irradiance, target, kind) for kind in (torch.float64, torch.float32))
    assert found.keys() == double.keys()
    assert len(found) > 4  # with gradients of adapters
    for name, value in double.items():
        assert found[name].shape == tuple(value.shape)
        assert far(found[name], value) < 3 * far(single[name], value) + ROUNDING, name


@pytest.mark.parametrize(
    ("network", "shape"),
    [pytest.param("published", (67, 121), marks=pytest.mark.slow), ("compact", (67, 121))],
)
def test_onnxruntime_gives_the_networks_result_and_gradients(network: str, shape: tuple[int, int]) -> None:
    check_parity(network, shape)


@pytest.mark.slow
@pytest.mark.parametrize(("network", "filters"), [("compact", 8), ("published", 4)])
def test_parity_at_the_size_of_a_panel(network: str, filters: int) -> None:
    check_parity(network, (1080, 1920), filters)


def test_adapters_are_inputs_whose_change_is_followed() -> None:
    """Stepping an adapter down its gradient lowers the loss that the file itself reports, as much as it says."""
    files = exported("compact", (67, 121), 4)
    adapters = safetensors.numpy.load(files[ADAPTERS])
    given = {
        name: np.random.default_rng(5).random((1, 3, 67, 121)).astype(np.float32)
        for name in ("irradiance", "target")
    }
    before = run(files[GRADIENT], given | adapters)
    slope = sum(float((before[f"gradient.{name}"].astype(float) ** 2).sum()) for name in adapters)
    step = 1e-3 * float(before["loss"]) / slope
    moved = {name: value - np.float32(step) * before[f"gradient.{name}"] for name, value in adapters.items()}
    after = run(files[GRADIENT], given | moved)
    assert float(before["loss"]) - float(after["loss"]) == pytest.approx(step * slope, rel=0.05)


def test_both_files_follow_adapters_and_the_first_has_them_by_default() -> None:
    files = exported("compact", (67, 121), 4)
    adapters = safetensors.numpy.load(files[ADAPTERS])
    light = np.random.default_rng(6).random((1, 3, 67, 121)).astype(np.float32)
    plain = run(files[APPROXIMATOR], {"irradiance": light})["corrected"]
    moved = {name: 1.3 * value for name, value in adapters.items()}
    first = run(files[APPROXIMATOR], {"irradiance": light, **moved})["corrected"]
    second = run(files[GRADIENT], {"irradiance": light, "target": light, **moved})["corrected"]
    assert far(first, torch.as_tensor(second).double()) < ROUNDING
    assert far(plain, torch.as_tensor(first).double()) > 1e-3
    same = run(files[APPROXIMATOR], {"irradiance": light, **adapters})["corrected"]
    np.testing.assert_array_equal(same, plain)


def test_baselines_are_not_exported() -> None:
    with pytest.raises(InputError, match="published or compact"):
        onnx_files(disturbed("unet", (32, 48)))
