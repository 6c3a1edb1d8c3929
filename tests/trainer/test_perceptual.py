"""Weights of others' networks: each file format gives the same features, and nothing in a file is run."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import scipy.io
import torch

from firmware_iface.errors import InputError
from trainer.networks.lpips import read_lpips
from trainer.networks.perceptual_loss import read_perceptual_loss
from trainer.networks.pretrained_features import (
    ALEXNET,
    VGG16,
    VGG19,
    Layer,
    PretrainedFeatures,
    load_features,
)
from trainer.networks.weight_files import read_weights


def random_weights(layout: tuple[Layer, ...], seed: int = 0) -> dict[str, torch.Tensor]:
    """Weights under the names that torchvision gives them."""
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    before, index = 3, 0
    for layer in layout:
        if isinstance(layer, str):
            index += 1
            continue
        width, kernel = layer[:2]
        spread = (2 / (before * kernel**2)) ** 0.5
        tensors[f"features.{index}.weight"] = (
            torch.randn(width, before, kernel, kernel, generator=generator) * spread
        )
        tensors[f"features.{index}.bias"] = torch.randn(width, generator=generator) * 0.1
        before, index = width, index + 2
    return tensors


def write_matconvnet(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """A .mat as MatConvNet lays it out: structs with a type and, for convolutions, weights [h, w, in, out]."""
    kind = [("type", object), ("weights", object)]
    layers = np.empty((1, 0), object)
    for name in [n for n in tensors if n.endswith("weight")]:
        kernel = np.transpose(tensors[name].numpy(), (2, 3, 1, 0))
        bias = tensors[name.replace("weight", "bias")].numpy()[:, None]
        both = np.empty((1, 2), object)
        both[0, 0], both[0, 1] = kernel, bias
        for type_, held in (("conv", both), ("relu", np.empty((0, 0)))):
            struct = np.empty((1, 1), kind)
            struct[0, 0] = (type_, held)
            cell = np.empty((1, 1), object)
            cell[0, 0] = struct
            layers = np.concatenate((layers, cell), 1)
    scipy.io.savemat(path, {"layers": layers})


def test_every_format_gives_the_same_features(tmp_path: Path) -> None:
    tensors = random_weights(VGG19)
    safetensors.torch.save_file(tensors, tmp_path / "vgg.safetensors")
    torch.save(tensors, tmp_path / "vgg.pth")
    write_matconvnet(tmp_path / "vgg.mat", tensors)
    x = torch.rand(1, 3, 40, 48)
    found = [
        load_features(read_weights(tmp_path / f"vgg.{kind}"), VGG19, (1, 13), kind)(x)
        for kind in ("safetensors", "pth", "mat")
    ]
    assert [f.shape[1] for f in found[0]] == [64, 512]
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_features_are_the_networks_own() -> None:
    """The first two layers by hand."""
    tensors = random_weights(VGG19)
    x = torch.rand(1, 3, 16, 16)
    ours = load_features(tensors, VGG19, (1,), "made")(x)[0]
    h = torch.relu(torch.conv2d(x, tensors["features.0.weight"], tensors["features.0.bias"], padding=1))
    h = torch.relu(torch.conv2d(h, tensors["features.2.weight"], tensors["features.2.bias"], padding=1))
    assert torch.equal(ours, h)


def test_the_perceptual_loss_vanishes_for_equal_pictures(tmp_path: Path) -> None:
    path = tmp_path / "vgg.safetensors"
    safetensors.torch.save_file(random_weights(VGG19), path)
    loss = read_perceptual_loss(path)
    target = torch.rand(1, 3, 40, 48)
    assert loss(target, target) == 0
    near, far = (loss(target + size * torch.randn_like(target), target) for size in (0.02, 0.2))
    assert 0 < near < far
    ours = (target + 0.1).requires_grad_(True)
    loss(ours, target).backward()
    assert ours.grad.abs().sum() > 0
    assert not any(p.requires_grad for p in loss.parameters())


@pytest.mark.parametrize(
    ("layout", "widths"), [(ALEXNET, (64, 192, 384, 256, 256)), (VGG16, (64, 128, 256, 512, 512))]
)
def test_lpips_is_a_distance(tmp_path: Path, layout: tuple[Layer, ...], widths: tuple[int, ...]) -> None:
    """0 for equal pictures, symmetric, and the heads' weighted mean of squared differences of unit features."""
    backbone, heads = tmp_path / "backbone.safetensors", tmp_path / "heads.pth"
    safetensors.torch.save_file(random_weights(layout), backbone)
    weights = {f"lin{k}.model.1.weight": torch.rand(1, width, 1, 1) for k, width in enumerate(widths)}
    torch.save(weights, heads)
    lpips = read_lpips([backbone, heads])
    first, second = torch.rand(2, 2, 3, 64, 64)
    assert torch.equal(lpips(first, first), torch.zeros(2))
    assert torch.allclose(lpips(first, second), lpips(second, first))
    assert (lpips(first, second) > 0).all()
    only = read_lpips([backbone, heads])
    for head in list(only.heads)[1:]:
        head.zero_()
    features = [only.features((2 * x - 1 - only.mean) / only.scale)[0] for x in (first, second)]
    unit = [torch.nn.functional.normalize(f, dim=1) for f in features]
    expected = ((unit[0] - unit[1]) ** 2 * only.heads[0]).sum(1).mean((1, 2))
    assert torch.allclose(only(first, second), expected, rtol=1e-4)
    with pytest.raises(InputError, match="heads"):
        read_lpips([backbone])


class Trap:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (Path.touch, (Path("sprung"),))


def test_nothing_in_a_pytorch_file_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "vgg.pth").write_bytes(pickle.dumps(Trap(), protocol=2))
    with pytest.raises(InputError, match="tensors alone"):
        read_weights(tmp_path / "vgg.pth")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("name", ["missing.pth", "weights.bin", "torn.safetensors", "torn.mat", "torn.pt"])
def test_files_that_cannot_be_read_are_refused(tmp_path: Path, name: str) -> None:
    if name.startswith("torn"):
        (tmp_path / name).write_bytes(b"torn")
    with pytest.raises(InputError, match=name):
        read_weights(tmp_path / name)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "alex.safetensors"
    safetensors.torch.save_file(random_weights(ALEXNET), path)
    with pytest.raises(InputError, match="another weights file"):
        read_perceptual_loss(path)
    assert len(PretrainedFeatures(VGG16, (0,)).convolutions()) == 13
