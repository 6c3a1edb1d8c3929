"""The processes and the device of a training run, and where its curves are logged."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import torch


def processes() -> tuple[int, int]:
    """(processes on this machine, machines), from the environment of torchrun; one and one without it."""
    local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return local, max(1, int(os.environ.get("WORLD_SIZE", "1")) // local)


def launched_fabric(folder: Path | None, device: str | None = None) -> Any:
    """A lightning Fabric, started in each process.

    Parameters
    ----------
    folder : path or None
        For TensorBoard's curves.
    device : str or None
        "cpu" or "cuda"; None: a GPU if there is one.
    """
    from lightning_fabric import Fabric
    from lightning_fabric.loggers import TensorBoardLogger

    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # it advises less than single precision
    local, machines = processes()
    gpu = device == "cuda" or (device is None and torch.cuda.is_available())
    fabric = Fabric(
        accelerator="cuda" if gpu else "cpu",
        devices=local,
        num_nodes=machines,
        precision="32-true",  # a GPU and the processor come to the same network
        loggers=TensorBoardLogger(folder, name="", version="curves") if folder else None,
    )
    if local * machines > 1:
        fabric.launch()
    return fabric
