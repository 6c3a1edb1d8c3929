"""CuPy without a GPU: arrays of the host's memory that refuse what CuPy's arrays refuse.

A `Far` array cannot become a NumPy array by itself, and meets no NumPy array in one operation. `in_cupys_place` puts
NumPy's and SciPy's functions over such arrays in the place of `cupy` and `cupyx.scipy.fft`.
"""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from typing import Any

import array_api_compat.numpy
import numpy as np
import pytest
import scipy.fft
from numpy.lib.mixins import NDArrayOperatorsMixin

FROM_THE_HOST = ("array", "asarray")  # these take NumPy's arrays


class Far(NDArrayOperatorsMixin):
    """An array elsewhere; what it gives is elsewhere, too, numbers of no dimension among it."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values

    def __array__(self, *args: Any, **kwargs: Any) -> np.ndarray:
        raise TypeError("implicit conversion to a NumPy array")

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        return _called(getattr(ufunc, method), inputs, kwargs)

    def __array_function__(self, function: Callable[..., Any], kinds: Any, args: Any, kwargs: Any) -> Any:
        return _called(function, args, kwargs)

    def __array_namespace__(self, **kwargs: Any) -> Any:
        return _over_far_arrays("array_api", array_api_compat.numpy)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # other ways to NumPy's arrays
            raise AttributeError(name)
        found = getattr(self._values, name)
        if callable(found):
            return lambda *args, **kwargs: _called(found, args, kwargs)
        return _far(found)

    def __getitem__(self, index: Any) -> Far:
        return Far(np.asarray(self._values[_near(index)]))

    def __setitem__(self, index: Any, value: Any) -> None:
        self._values[_near(index)] = _near(value)

    def __len__(self) -> int:
        return len(self._values)

    def __float__(self) -> float:
        return float(self._values)

    def __int__(self) -> int:
        return int(self._values)

    def __bool__(self) -> bool:
        return bool(self._values)


def in_cupys_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until the test ends, `import cupy` gives NumPy's functions over arrays elsewhere."""
    cupyx, inner = types.ModuleType("cupyx"), types.ModuleType("cupyx.scipy")
    cupy, fft = _over_far_arrays("cupy", np), _over_far_arrays("cupyx.scipy.fft", scipy.fft)
    cupy.asnumpy = lambda x: x._values.copy()  # type: ignore[attr-defined]
    cupyx.scipy, inner.fft = inner, fft  # type: ignore[attr-defined]
    for module in (cupy, cupyx, inner, fft):
        monkeypatch.setitem(sys.modules, module.__name__, module)


def _over_far_arrays(name: str, library: types.ModuleType) -> types.ModuleType:
    """A library of functions over NumPy's arrays as one over arrays elsewhere."""

    def function(name: str) -> Any:
        found = getattr(library, name)
        if isinstance(found, type) or not callable(found):
            return found
        if name in FROM_THE_HOST:
            return lambda x, *args, **kwargs: Far(found(_values(x), *args, **kwargs))
        return lambda *args, **kwargs: _called(found, args, kwargs)

    made = types.ModuleType(name)
    made.__getattr__ = function  # type: ignore[method-assign]
    return made


def _called(function: Callable[..., Any], args: Any, kwargs: Any) -> Any:
    return _far(function(*_near(tuple(args)), **{name: _near(value) for name, value in kwargs.items()}))


def _near(x: Any) -> Any:
    """The values of an argument, of a tuple's or a list's elements, too; NumPy's arrays are refused."""
    if isinstance(x, np.ndarray):
        raise TypeError("Unsupported type <class 'numpy.ndarray'>")
    if isinstance(x, tuple | list):
        return type(x)(_near(each) for each in x)
    return _values(x)


def _values(x: Any) -> Any:
    return x._values if isinstance(x, Far) else x


def _far(x: Any) -> Any:
    return Far(np.asarray(x)) if isinstance(x, np.ndarray | np.number | np.bool_) else x
