"""Where the light path computes: on the processor, or on a GPU.

torch puts a new tensor on its default device, so `computing_on` around a piece of work decides for all of it: captures
and models become tensors there, and what follows from them stays. Three things need more than that: the way back to
NumPy (`array_of`), work on the processor in the middle of the rest (`computing_on("cpu")`), and results that are kept
for later (`trainer.kept_results`). In a backward pass torch does not know its default device: what runs there, in
`runtime.lightpath`, makes new arrays on the device of those that it is given.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.program.interrupt import ctrl_c_waits

with ctrl_c_waits():  # in the middle of it, Ctrl-C is lost, or ends the process without a word
    import torch
    from torch import Tensor


@contextmanager
def computing_on(device: str) -> Iterator[None]:
    """New tensors are on a device; of several processes that torchrun started, each has a GPU of its own.

    Parameters
    ----------
    device : str
        "cpu" or "cuda".

    Raises
    ------
    InputError
        For "cuda" where torch finds no such device.
    """
    if device == torch.get_default_device().type:
        yield
        return
    if device == "cpu":
        with torch.device(device):
            yield
        return
    if not torch.cuda.is_available():
        raise InputError(
            "torch finds no CUDA device on this machine: leave out --device, or install a build of torch with CUDA"
        )
    with torch.device(device, int(os.environ.get("LOCAL_RANK", "0"))), whole_single_precision():
        yield


@contextmanager
def one_thread() -> Iterator[None]:
    """Each tensor is computed by one thread: on small arrays, more would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def whole_single_precision() -> Iterator[None]:
    """Products and convolutions on a GPU keep all 23 bits, where TF32 would leave 10."""
    kinds: tuple[Any, ...] = (torch.backends.cuda.matmul, torch.backends.cudnn)
    before = [kind.allow_tf32 for kind in kinds]
    for kind in kinds:
        kind.allow_tf32 = False
    try:
        yield
    finally:
        for kind, was in zip(kinds, before, strict=True):
            kind.allow_tf32 = was


def array_of(tensor: Tensor) -> np.ndarray:
    """A tensor's values in the host's memory, without its derivatives; on the processor it is the same memory."""
    return np.asarray(tensor.detach().cpu().numpy())
