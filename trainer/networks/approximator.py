"""The approximator D: irradiance plus a network's correction of it.

Every network starts with its last layer at zero, so D starts as the identity, exactly.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from firmware_iface.errors import InputError, nearest
from runtime.bundle.whole_files import whole_file
from trainer.device import computing_on
from trainer.networks.compact_network import CompactNetwork
from trainer.networks.pix2pix import Pix2Pix
from trainer.networks.pix2pixhd import Pix2PixHD
from trainer.networks.published_generator import Generator
from trainer.networks.unet import UNet

FORMAT = "hololoop-approximator"
NETWORK = "network.safetensors"  # its file in the folder of a run
DYNAMIC_RANGE = 1e-3  # of irradiance: added before square roots, whose slope is unbounded in the dark

_NETWORKS: dict[str, Callable[[tuple[int, int], int, int], nn.Module]] = {
    "published": lambda shape, filters, planes: Generator(filters, planes),
    "compact": CompactNetwork,
    "unet": lambda shape, filters, planes: UNet(filters, planes),
    "pix2pix": lambda shape, filters, planes: Pix2Pix(filters, planes),
    "pix2pixhd": lambda shape, filters, planes: Pix2PixHD(filters, planes),
}
NETWORKS = tuple(_NETWORKS)
FULL_FILTERS = {"published": 64, "compact": 8, "unet": 32, "pix2pix": 64, "pix2pixhd": 32}


@dataclass(frozen=True)
class Architecture:
    """Which network, and for which panel.

    Attributes
    ----------
    network : str
        One of `NETWORKS`.
    filters : int
        Channels of its first layer, even.
    shape : (int, int)
        Rows and columns of the panel.
    planes : int
        Colours.
    """

    network: str
    filters: int
    shape: tuple[int, int]
    planes: int = 3

    def __post_init__(self) -> None:
        if self.network not in NETWORKS:
            raise InputError(f"there is no network '{self.network}': {nearest(self.network, NETWORKS)}")
        if self.filters < 2 or self.filters % 2:
            raise InputError(f"{self.filters} filters: give an even number from 2 on")


class Approximator(nn.Module):
    """D(I) = I + network(I), for irradiance [B, C, H, W]; the identity until it is trained."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        make = _NETWORKS[architecture.network]
        self.network = make(architecture.shape, architecture.filters, architecture.planes)
        last: Any = self.network.last
        for weight in last.parameters():
            nn.init.zeros_(weight)

    def forward(self, irradiance: Tensor) -> Tensor:
        return irradiance + self.network(irradiance)

    def adapters(self) -> dict[str, Tensor]:
        """The weights of the last layer, by name: few and linear in the result, so quick to refine."""
        return {n: p for n, p in self.named_parameters() if n.startswith("network.last.")}


def amplitude(irradiance: Tensor) -> Tensor:
    """Square root of irradiance, flat in the dark; shot noise is equal in it for all brightnesses."""
    return torch.sqrt(torch.clamp(irradiance, min=0) + DYNAMIC_RANGE)


def penalty(corrected: Tensor, target: Tensor, weight: Tensor | float = 1.0) -> Tensor:
    """Sum of squared differences of amplitude, which phase retrieval minimises.

    Parameters
    ----------
    corrected, target : Tensor [..., C, H, W]
        Irradiance; the target is already scaled to the corrected one.
    weight : Tensor or float
        How much a pixel counts.
    """
    difference = amplitude(corrected) - amplitude(target)
    return (weight * (difference * difference)).sum()


def write_approximator(path: Path | str, network: Approximator, about: dict[str, Any]) -> None:
    """Write a trained approximator as safetensors, whole or not at all.

    Parameters
    ----------
    path : path
        The file.
    network : Approximator
        What is written.
    about : dict
        Where it comes from, as JSON in the file's header.
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    header = {"format": FORMAT, "architecture": asdict(network.architecture), "about": about}
    with whole_file(path) as file:
        file.write(save(tensors, {"hololoop": json.dumps(header)}))


def read_about(path: Path | str) -> dict[str, Any]:
    """Where an approximator comes from, as `write_approximator` got it, without its weights; {} where it says nothing.

    Raises
    ------
    InputError
        Where the file cannot be read.
    """
    try:
        with safe_open(path, "pt") as file:
            header = json.loads((file.metadata() or {}).get("hololoop", "{}"))
    except (OSError, SafetensorError, ValueError) as error:
        raise InputError(f"{path} cannot be read as an approximator ({error}): train one") from None
    return dict(header.get("about", {})) if isinstance(header, dict) else {}


@computing_on("cpu")
def read_approximator(path: Path | str) -> tuple[Approximator, dict[str, Any]]:
    """An approximator from its file.

    Returns
    -------
    Approximator
        On the CPU, in evaluation mode.
    dict
        Its `about`, as `write_approximator` got it.

    Raises
    ------
    InputError
        Where the file cannot be read or is not an approximator.
    """
    try:
        with safe_open(path, "pt") as file:
            header = json.loads((file.metadata() or {}).get("hololoop", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    except (OSError, SafetensorError, ValueError) as error:
        raise InputError(f"{path} cannot be read as an approximator ({error}): train one") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError(f"{path} is not an approximator: give the network.safetensors that train wrote")
    try:
        given = header["architecture"]
        network = Approximator(
            Architecture(
                given["network"],
                int(given["filters"]),
                (int(given["shape"][0]), int(given["shape"][1])),
                int(given["planes"]),
            )
        )
        network.load_state_dict(tensors)
    except (KeyError, TypeError, IndexError, RuntimeError) as error:
        reason = str(error).splitlines()[0][:120]
        raise InputError(
            f"{path} does not hold the network that it names ({reason}): train it again"
        ) from None
    return network.eval(), dict(header.get("about", {}))
