"""Files with the weights of networks that others trained, as tensors by name.

PyTorch files are read as tensors alone (nothing in them is run); safetensors and the .mat files of MatConvNet are read
too.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from firmware_iface.errors import InputError


def read_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a weights file, by name.

    Raises
    ------
    InputError
        Where the file is missing, of another format or cannot be read.
    """
    readers = {".safetensors": _safetensors, ".mat": _matconvnet, ".pt": _pytorch, ".pth": _pytorch}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is not a weights file of a known format: give {', '.join(readers)}")
    if not path.is_file():
        raise InputError(f"{path} is missing: name the weights file that you have")
    return reader(path)


def _safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} cannot be read as safetensors ({error}): copy it again") from None


def _pytorch(path: Path) -> dict[str, Tensor]:
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the safe reader has no common error
        reason = (str(error).splitlines() or [type(error).__name__])[0][:80]
        raise InputError(
            f"{path} cannot be read as a PyTorch file of tensors alone ({reason}): save its state dict as safetensors"
        ) from None
    if not isinstance(found, Mapping):
        raise InputError(f"{path} holds no table of tensors: save a state dict")
    return {str(name): value for name, value in found.items() if isinstance(value, Tensor)}


def _matconvnet(path: Path) -> dict[str, Tensor]:
    import numpy as np
    import scipy.io

    try:
        layers = np.atleast_1d(scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)["layers"])
    except Exception as error:  # SciPy's reader has no common error
        raise InputError(f"{path} is not a .mat of MatConvNet ({error}): name another weights file") from None
    tensors: dict[str, Tensor] = {}
    for number, layer in enumerate(layers):
        if getattr(layer, "type", "") != "conv":
            continue
        kernel, bias = layer.weights if hasattr(layer, "weights") else (layer.filters, layer.biases)
        # [row, column, in, out]; squeezing removes axes of length 1 only in layers that are not used here
        if kernel.ndim == 4:
            tensors[f"{number}.weight"] = torch.tensor(
                np.transpose(kernel, (3, 2, 0, 1)), dtype=torch.float32
            )
            tensors[f"{number}.bias"] = torch.tensor(np.atleast_1d(bias), dtype=torch.float32)
    return tensors
