"""A second device without a GPU: tensors that say that they are elsewhere, and behave so.

A `Far` tensor carries its values in the host's memory, where everything is computed, but it refuses what a tensor on a
GPU refuses: to become a NumPy array, and to meet a tensor of the host in one operation unless that has no dimension.
Inside `second_device()` new tensors are far, as they are on a GPU inside `trainer.device.computing_on("cuda")`. Its
device is called "meta", because torch lets nothing else go without a driver.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import array_api_compat.torch
import numpy as np
import torch
from torch import Tensor
from torch.overrides import _get_current_function_mode_stack
from torch.utils._device import DeviceContext, _device_constructors
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

HERE, THERE = torch.device("cpu"), torch.device("meta")
aten = torch.ops.aten
# What may take a host's tensor of any size beside a far one.
MEETING = {
    aten.copy_.default,
    aten.index.Tensor,
    aten.index_put.default,
    aten.index_put_.default,
    aten._index_put_impl_.default,
}
# What may not even take one of no dimension.
STRICT = {aten.cat.default, aten.stack.default}


class Far(Tensor):
    """A tensor on the second device, with its `values` in the host's memory."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> Far:
        return Tensor._make_wrapper_subclass(
            cls,
            values.shape,
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=THERE,
            requires_grad=False,
        )

    def __init__(self, values: Tensor) -> None:
        self.values = values

    def __getitem__(self, index: Any) -> Any:
        return super().__getitem__(_plain_index(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        if not isinstance(value, Tensor):
            value = Far(torch.tensor(value, dtype=self.dtype, device=HERE))
        super().__setitem__(_plain_index(index), value)

    def tolist(self) -> Any:
        return self.detach().values.tolist()

    def __repr__(self) -> str:  # type: ignore[override]
        return f"Far({tuple(self.shape)})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {})


class _EveryOperation(TorchDispatchMode):
    """Sees what makes a tensor on the second device out of nothing, or out of the host's memory."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {})


def _computed(func: Any, args: Any, kwargs: Any) -> Any:
    """The result of an operation, computed in the host's memory; far where an argument or the device says so."""
    tensors = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
    near = [t for t in tensors if not isinstance(t, Far)]
    device = kwargs.get("device")
    if len(near) == len(tensors) and device != THERE:
        return func(*args, **kwargs)
    if len(near) < len(tensors) and func not in MEETING and any(t.ndim or func in STRICT for t in near):
        raise RuntimeError(f"{func}: a tensor of the host's memory meets one of the second device")
    if any(t.device == THERE for t in near):
        raise RuntimeError(f"{func}: a tensor of the second device has no values")
    if device is not None:
        kwargs = {**kwargs, "device": HERE}
    found = func(*tree_map(_values, args), **tree_map(_values, kwargs))
    if torch.Tag.inplace_view in func.tags:  # changes a shape in place: the wrapper's, too
        with no_dispatch():
            func(*args, **kwargs)
    if func._schema.is_mutable and not isinstance(found, tuple | list):
        return args[0]  # changed in place
    return found if device == HERE else tree_map(_far, found)


@contextmanager
def second_device() -> Iterator[None]:
    """New tensors are on the second device."""
    with torch.device(THERE), _EveryOperation(), ExitStack() as patches:
        for module, name in (
            (torch, "tensor"),
            (torch, "as_tensor"),
            (torch, "asarray"),
            (array_api_compat.torch, "asarray"),
        ):
            patches.enter_context(patch.object(module, name, _from_numbers(getattr(module, name))))
        # torch keeps a list of what makes tensors, with the patched functions where it was first asked in here
        patches.callback(_device_constructors.cache_clear)
        yield


def _from_numbers(make: Any) -> Any:
    """What makes a tensor of Python's and NumPy's numbers, which `_EveryOperation` does not see."""

    def made(data: Any, *args: Any, device: Any = None, requires_grad: bool = False, **kwargs: Any) -> Any:
        where = _default_device() if device is None else torch.device(device)
        if isinstance(data, Far) or (isinstance(data, Tensor) and where == THERE):
            return make(data, *args, device=where, **kwargs)
        found = make(data, *args, device=HERE, **kwargs)
        return (Far(found) if where == THERE else found).requires_grad_(requires_grad)

    return made


def _default_device() -> torch.device:
    """As `torch.get_default_device`, which makes a tensor to find out."""
    modes = [m for m in _get_current_function_mode_stack() if isinstance(m, DeviceContext)]
    return modes[-1].device if modes else HERE


def _values(x: Any) -> Any:
    return x.values if isinstance(x, Far) else x


def _far(x: Any) -> Any:
    """A result as a far tensor; conjugated at once, because the wrapper would not know of it."""
    if not isinstance(x, Tensor) or isinstance(x, Far):
        return x
    return Far(x.resolve_conj().resolve_neg())


def _plain_index(index: Any) -> Any:
    """An index whose lists and arrays are tensors of the host's memory, as a GPU takes them."""
    if isinstance(index, tuple):
        return tuple(_plain_index(i) for i in index)
    if isinstance(index, list | np.ndarray):
        return torch.tensor(np.asarray(index), device=HERE)
    return index
