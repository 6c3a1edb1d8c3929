"""Networks: the identity at the start, the layers of the paper, and the field of view of each part."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from firmware_iface.errors import InputError
from trainer.networks.approximator import (
    NETWORKS,
    Approximator,
    Architecture,
    penalty,
    read_approximator,
    write_approximator,
)
from trainer.networks.discriminator import PatchDiscriminator
from trainer.networks.layers import InstanceNorm, LeakyReLU, cropped
from trainer.networks.published_generator import Generator
from trainer.networks.unet import UNet

# Chakravarthula et al. 2020, Fig. 14, from the table: (kernel, channels in, channels out)
GENERATOR = [
    (5, 3, 64), (5, 64, 128), (5, 128, 256), (5, 256, 512), *[(5, 512, 512)] * 4,
    (4, 512, 512), *[(4, 1024, 512)] * 3, (4, 1024, 256), (4, 512, 128), (4, 256, 64), (4, 128, 32), (4, 32, 3),
]  # fmt: skip
DISCRIMINATOR = [(4, 6, 64), (4, 64, 128), (4, 128, 256), (4, 256, 512), (4, 512, 512), (4, 512, 1)]


def weights(table: list[tuple[int, int, int]]) -> int:
    return sum(kernel**2 * before * after + after for kernel, before, after in table)


def disturbed(network: str, shape: tuple[int, int], filters: int = 4, planes: int = 3) -> Approximator:
    """An approximator that is not the identity."""
    torch.manual_seed(3)
    one = Approximator(Architecture(network, filters, shape, planes))
    for value in one.parameters():
        value.data.add_(0.05 * torch.randn_like(value))
    return one.eval()


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("shape", [(64, 96), (67, 121)])
def test_every_network_starts_as_the_identity_and_can_leave_it(network: str, shape: tuple[int, int]) -> None:
    irradiance = torch.rand(1, 3, *shape)
    one = Approximator(Architecture(network, 4, shape)).eval()
    assert torch.equal(one(irradiance), irradiance)
    changed = disturbed(network, shape)(irradiance)
    assert changed.shape == irradiance.shape
    assert (changed - irradiance).abs().max() > 1e-3


def test_the_published_networks_have_the_layers_of_their_table() -> None:
    assert sum(p.numel() for p in Generator().parameters()) == weights(GENERATOR)
    assert sum(p.numel() for p in PatchDiscriminator().parameters()) == weights(DISCRIMINATOR)
    kernels = [p.shape for p in Generator().parameters() if p.ndim == 4]
    assert [(k[2], *sorted(k[:2])) for k in kernels] == [(k, *sorted((a, b))) for k, a, b in GENERATOR]


def test_instance_norm_is_on_the_inner_layers_only() -> None:
    generator = Generator(4)
    normed = [any(isinstance(m, InstanceNorm) for m in level) for level in (*generator.down, *generator.up)]
    assert normed == [False] * 2 + [True] * 6 + [True] * 6 + [False] * 2
    rectified = [any(isinstance(m, LeakyReLU) for m in level) for level in (*generator.down, *generator.up)]
    assert rectified == [True] * 15 + [False]
    assert not any(isinstance(m, torch.nn.Dropout) for m in generator.modules())


@pytest.mark.parametrize(("plain", "side"), [(2, 94), (1, 70)])
def test_a_patch_of_the_discriminator_sees_94_pixels(plain: int, side: int) -> None:
    """The support of the gradient of one judgement, without the norms, which cover everything."""
    discriminator = PatchDiscriminator(1, 4, plain=plain)
    layers = torch.nn.Sequential(
        *[m for m in discriminator.layers if isinstance(m, torch.nn.Conv2d)]
    ).double()
    picture = torch.rand(1, 1, 256, 256, dtype=torch.float64, requires_grad=True)
    judged = layers(picture)
    judged[0, 0, judged.shape[2] // 2, judged.shape[3] // 2].backward()
    support = picture.grad[0, 0].abs() > 0
    assert (int(support.any(1).sum()), int(support.any(0).sum())) == (side, side)


def test_u_net_has_half_the_filters_of_the_original() -> None:
    wide, deep = UNet().widen[0].in_channels, UNet().down[0][0].out_channels
    assert (deep, wide) == (32, 512)


def test_layers_agree_with_torch_to_rounding_with_their_gradients() -> None:
    x = torch.randn(2, 3, 5, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(InstanceNorm(), x)
    assert torch.autograd.gradcheck(LeakyReLU(0.02), x)
    assert torch.autograd.gradcheck(lambda t: cropped(t, t[:, :, :4, :5]), x)
    assert torch.allclose(InstanceNorm()(x), torch.nn.functional.instance_norm(x, eps=1e-5))
    assert torch.equal(InstanceNorm()(torch.rand(1, 2, 1, 1)), torch.zeros(1, 2, 1, 1))


@pytest.mark.parametrize("network", ["published", "compact"])
def test_the_gradient_of_the_penalty_is_its_slope(network: str) -> None:
    """Along a random direction, against a central difference, in double precision."""
    one = disturbed(network, (40, 56)).double()
    target = torch.rand(1, 3, 40, 56, dtype=torch.float64)
    x = (0.2 + torch.rand(1, 3, 40, 56, dtype=torch.float64)).requires_grad_(True)
    direction = torch.randn_like(x)
    (gradient,) = torch.autograd.grad(penalty(one(x), target), x)
    step = 1e-6
    with torch.no_grad():
        rise = penalty(one(x + step * direction), target) - penalty(one(x - step * direction), target)
    assert float((gradient * direction).sum()) == pytest.approx(float(rise) / (2 * step), rel=1e-5)


def test_colours_of_the_compact_network_do_not_mix() -> None:
    one = disturbed("compact", (32, 48))
    x = torch.rand(1, 3, 32, 48, requires_grad=True)
    one(x)[:, 1].sum().backward()
    assert x.grad[:, 1].abs().min() > 0
    assert torch.equal(x.grad[:, [0, 2]], torch.zeros(1, 2, 32, 48))


def test_an_approximator_survives_its_file(tmp_path: Path) -> None:
    one, path = disturbed("compact", (33, 47)), tmp_path / "network.safetensors"
    write_approximator(path, one, {"steps": 7})
    again, about = read_approximator(path)
    x = torch.rand(1, 3, 33, 47)
    assert about == {"steps": 7}
    assert again.architecture == one.architecture
    assert torch.equal(again(x), one(x))


@pytest.mark.parametrize("content", [b"", b"not safetensors", b"\x02\0\0\0\0\0\0\0{}"])
def test_a_file_that_is_no_approximator_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "network.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match="approximator"):
        read_approximator(path)
    with pytest.raises(InputError, match="read"):
        read_approximator(tmp_path / "missing.safetensors")


def test_unknown_networks_and_widths_are_refused() -> None:
    with pytest.raises(InputError, match="compact"):
        Architecture("compakt", 4, (8, 8))
    with pytest.raises(InputError, match="even"):
        Architecture("compact", 3, (8, 8))
