"""Checkpoints of a training run: written whole, and read by a run with the same settings."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from firmware_iface.errors import InputError
from runtime.bundle.whole_files import whole_file

CHECKPOINT = "checkpoint.pt"


def write_checkpoint(folder: Path, settings: dict[str, Any], state: dict[str, Any]) -> None:
    """Write the state of a run.

    Parameters
    ----------
    folder : path
        Of the run.
    settings : dict
        Those that a continued run must share.
    state : dict
        Its step, and weights and optimiser of each network.
    """
    data = io.BytesIO()  # since torch says of a full disk that it is an error of its own
    torch.save({"settings": settings, **state}, data)
    with whole_file(folder / CHECKPOINT) as file:
        file.write(data.getbuffer())


def read_checkpoint(folder: Path, settings: dict[str, Any], device: torch.device) -> dict[str, Any] | None:
    """The state that `write_checkpoint` wrote, on a device; None where there is none.

    Raises
    ------
    InputError
        Where the checkpoint cannot be read, or is of a run with other settings.
    """
    state = _read(folder, device)
    if state is not None:
        before = state["settings"]
        _refuse_other(folder, before, settings, [*{**before, **settings}])
    return state


def refuse_other_run(folder: Path, settings: dict[str, Any]) -> None:
    """Refuse to continue a run whose checkpoint has other values of these settings, before any work is done.

    Raises
    ------
    InputError
        As `read_checkpoint`.
    """
    state = _read(folder, torch.device("cpu"), mapped=True)  # the weights stay on the disk
    if state is not None:
        _refuse_other(folder, state["settings"], settings, list(settings))


def _read(folder: Path, device: torch.device, mapped: bool = False) -> dict[str, Any] | None:
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    try:
        state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True, mmap=mapped)
        _ = state["settings"].items()
    except Exception as error:
        reason = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
        raise InputError(f"{path} cannot be read ({reason}): remove it or give another --out") from None
    return state


def _refuse_other(folder: Path, before: dict[str, Any], settings: dict[str, Any], keys: list[str]) -> None:
    for key in keys:
        if _plain(before.get(key)) != _plain(settings.get(key)):
            raise InputError(
                f"{folder} holds a training with another {key}: give another --out, or --overwrite to begin anew"
            )


def _plain(value: Any) -> Any:
    """With tuples as lists, as a checkpoint gives them back."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value
