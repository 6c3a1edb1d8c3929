"""CuPy without a GPU: arrays of the host's memory that refuse what CuPy's arrays refuse.

A `Far` array cannot become a NumPy array by itself, and meets no NumPy array in one operation. `in_cupys_place` puts
NumPy's and SciPy's functions over such arrays in the place of `cupy` and `cupyx.scipy.fft`.

Streams record, too: what is called meanwhile leaves nothing behind, and is done when the graph is launched. As on a
GPU, a number that the host has taken stays what it was, and the host cannot ask for one.
"""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import array_api_compat.numpy
import numpy as np
import pytest
import scipy.fft
from numpy.lib.mixins import NDArrayOperatorsMixin

FROM_THE_HOST = ("array", "asarray")  # these take NumPy's arrays
FORWARD, INVERSE = -1, 1


class Graph:
    """Calls, and the arrays that they made."""

    recording: Graph | None = None  # at present

    def __init__(self) -> None:
        self.calls: list[tuple[Callable[..., Any], Any, Any, Any]] = []
        self._written: list[tuple[np.ndarray, np.ndarray]] = []

    def call(self, function: Callable[..., Any], args: Any, kwargs: Any, written: Any = ()) -> Any:
        """What a function over NumPy's arrays returns; `written` are the arrays that it writes to."""
        self._written += [(one, one.copy()) for one in written]
        result = function(*args, **kwargs)
        if isinstance(result, np.number | np.bool_):
            result = np.asarray(result)
        self.calls.append((function, args, kwargs, result))
        return result

    def end(self) -> None:
        """Take back what was written: nothing has happened yet."""
        for one, before in reversed(self._written):
            one[...] = before

    def launch(self) -> None:
        """Do it all."""
        for function, args, kwargs, made in self.calls:
            result = function(*args, **kwargs)
            if isinstance(made, np.ndarray) and result is not made:
                made[...] = result


class Stream:
    """One that records."""

    def __init__(self, non_blocking: bool) -> None:
        assert non_blocking, "others may work on the stream that waits for all"

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *error: object) -> None:
        """Nothing is held."""

    def begin_capture(self) -> None:
        Graph.recording = Graph()

    def end_capture(self) -> Graph:
        graph, Graph.recording = Graph.recording, None
        assert graph is not None
        graph.end()
        return graph


class PlanNd:
    """A transform of complex arrays along one axis, by the distances of its samples and of its rows."""

    def __init__(self, shape: Any, inembed: Any, *plan: Any) -> None:
        (self.length,), (self.step, self.between, _, to_step, to_between, _, self.batch, *_) = shape, plan
        self.to = to_step, to_between

    def fft(self, x: Far, out: Far, direction: int) -> None:
        from_steps = [s // x.itemsize for s in x.strides]
        axis = from_steps.index(self.step)
        assert from_steps[1 - axis] == self.between and out.strides[axis] == self.to[0] * x.itemsize
        assert x.shape[axis] == self.length and x.shape[1 - axis] == self.batch

        def transform(values: np.ndarray, into: np.ndarray) -> None:
            if direction == FORWARD:
                into[...] = scipy.fft.fft(values, axis=axis)
            else:
                into[...] = scipy.fft.ifft(values, axis=axis, norm="forward")

        _called(transform, (x, out), {}, (out._values,))


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

    @property
    def data(self) -> Any:
        return types.SimpleNamespace(ptr=self._values.ctypes.data)

    def __getitem__(self, index: Any) -> Far:
        index = _near(index) if isinstance(index, tuple) else (_near(index),)
        more = (
            () if any(one is Ellipsis for one in index) else (Ellipsis,)
        )  # with it, one number is a view, too
        view = self._values[*index, *more]
        if np.shares_memory(view, self._values) or not view.size:
            return Far(view)
        return _called(lambda values: values[*index, *more], (self,), {})

    def __setitem__(self, index: Any, value: Any) -> None:
        def put(values: np.ndarray, index: Any, value: Any) -> None:
            values[index] = value

        _called(put, (self, index, value), {}, (self._values,))

    def __len__(self) -> int:
        return len(self._values)

    def __float__(self) -> float:
        return float(_for_the_host(self))

    def __int__(self) -> int:
        return int(_for_the_host(self))

    def __bool__(self) -> bool:
        return bool(_for_the_host(self))


def in_cupys_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until the test ends, `import cupy` gives NumPy's functions over arrays elsewhere."""
    cupyx, inner = types.ModuleType("cupyx"), types.ModuleType("cupyx.scipy")
    cupy, fft = _over_far_arrays("cupy", np), _over_far_arrays("cupyx.scipy.fft", scipy.fft)
    cupy.asnumpy = lambda x: _for_the_host(x).copy()  # type: ignore[attr-defined]
    kinds = {"CUFFT_FORWARD": FORWARD, "CUFFT_INVERSE": INVERSE, "CUFFT_C2C": 0x29, "CUFFT_Z2Z": 0x69}
    cupy.cuda = types.SimpleNamespace(  # type: ignore[attr-defined]
        Stream=Stream,
        MemoryPool=lambda: types.SimpleNamespace(malloc=None),
        using_allocator=lambda malloc: nullcontext(),
        cufft=types.SimpleNamespace(PlanNd=PlanNd, **kinds),
    )
    fft.get_fft_plan = lambda *args: nullcontext()  # type: ignore[attr-defined]
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
            return lambda x, *args, **kwargs: Far(found(_from_the_host(x), *args, **kwargs))
        return lambda *args, **kwargs: _called(found, args, kwargs)

    made = types.ModuleType(name)
    made.__getattr__ = function  # type: ignore[method-assign]
    return made


def _called(function: Callable[..., Any], args: Any, kwargs: Any, written: Any = ()) -> Any:
    args, kwargs = _near(tuple(args)), {name: _near(value) for name, value in kwargs.items()}
    if Graph.recording is None:
        return _far(function(*args, **kwargs))
    out = kwargs.get("out", ())
    if function in (np.copyto, np.put):
        written = args[:1]
    return _far(
        Graph.recording.call(function, args, kwargs, (*written, *(out if isinstance(out, tuple) else (out,))))
    )


def _for_the_host(x: Far) -> np.ndarray:
    if Graph.recording is not None:
        raise RuntimeError("operation not permitted when stream is capturing")
    return x._values


def _from_the_host(x: Any) -> Any:
    if Graph.recording is not None:
        raise RuntimeError("operation not permitted when stream is capturing")
    return _values(x)


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
