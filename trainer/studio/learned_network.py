"""A network that was trained beyond the model of the page: its file next to the model file, and what it gains."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from firmware_iface.errors import InputError
from trainer.model.model import Model
from trainer.networks.approximator import NETWORK, read_about


@dataclass(frozen=True)
class LearnedNetwork:
    """A network that makes the prediction better.

    Attributes
    ----------
    path : Path
        Of its file.
    before, after : float
        Excess on held-out captures without and with it.
    """

    path: Path
    before: float
    after: float


def network_folder(model_path: Path) -> Path:
    """Where the page keeps the network of a model file."""
    return model_path.with_name(f"{model_path.stem}-network")


def network_of(model_path: Path, model: Model, captures: str) -> LearnedNetwork | None:
    """The network that was trained beyond this model and makes it better; None where there is none.

    Parameters
    ----------
    captures : str
        Name of the set.
    """
    path = network_folder(model_path) / NETWORK
    if not path.is_file():
        return None
    try:
        about = read_about(path)
    except InputError:
        return None
    before, after = about.get("excess_before"), about.get("excess_after")
    if not (
        isinstance(before, float) and isinstance(after, float) and math.isfinite(after) and after < before
    ):
        return None
    same = sorted(about.get("effects", ())) == sorted(model.parts) and about.get("captures") == captures
    return LearnedNetwork(path, before, after) if same else None
