"""The solver's arrays on a GPU, with CuPy, and work that is recorded there once and then repeated as a whole.

A pattern takes hundreds of operations of a few microseconds each, and the host needs longer to start one than the GPU
to do it. So what is done again and again becomes a CUDA graph, which the host starts as one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from runtime.lightpath import fft
from runtime.solver.array_backend import Array, Backend, Number, Strip, Work


class CupyBackend(Backend):
    """CuPy arrays on the GPU: a strip is the whole array."""

    name = "cupy"

    def __init__(self) -> None:
        import cupy
        import cupyx.scipy.fft

        self.xp, self._fft, self._cuda = cupy, cupyx.scipy.fft, cupy.cuda
        self.threads, self.host_cores, self.pool = 1, fft.THREADS, None
        self._plans: dict[Any, Any] = {}
        # A plan has one area to work in, and several solvers may be at work at a time.
        self._planning = threading.Lock()

    def strip_rows(self, width: int) -> int:
        return 1 << 30

    def over_rows(self, rows: int, size: int, work: Strip) -> tuple[Number, ...]:
        return work(0, slice(0, rows)) or ()

    def rows_fft(self, x: Array, out: Array, forward: bool) -> None:
        self._transform(x, out, 1, forward)

    def columns_fft(self, x: Array, forward: bool) -> None:
        self._transform(x, x, 0, forward)

    def column_blocks(self, x: Array) -> dict[int, Array]:
        return {0: x}

    def column_room(self, x: Array) -> list[Array]:
        return []

    def through_columns(
        self, x: Array, factors: dict[int, Array], room: list[Array], multiply: Callable[[Array, Array], None]
    ) -> None:
        self.columns_fft(x, True)
        multiply(x, factors[0])
        self.columns_fft(x, False)

    def _transform(self, x: Array, out: Array, axis: int, forward: bool) -> None:
        """Unscaled DFT of `x` [n, m] along an axis, straight into `out`, whatever their strides are."""
        cufft = self._cuda.cufft
        across, lengths = 1 - axis, [x.shape[axis]]
        steps = [s // x.itemsize for a in (x, out) for s in (a.strides[axis], a.strides[across])]
        key = (*lengths, x.shape[across], *steps, x.dtype.char)
        with self._planning:
            if key not in self._plans:
                kind = cufft.CUFFT_C2C if x.dtype == np.complex64 else cufft.CUFFT_Z2Z
                self._plans[key] = cufft.PlanNd(
                    lengths, lengths, *steps[:2], lengths, *steps[2:], kind, x.shape[across], "C", 0, None
                )
            self._plans[key].fft(x, out, cufft.CUFFT_FORWARD if forward else cufft.CUFFT_INVERSE)

    def filter(self, image: Array, transfer: Array, spectrum: Array) -> None:
        with self._planning:
            # A recording needs its plans as long as it lives; the library's own cache forgets them.
            key, plan = (image.shape, image.dtype.char), self._fft.get_fft_plan
            if key not in self._plans:
                ways = ((image, "R2C"), (spectrum, "C2R"))
                self._plans[key] = [plan(x, image.shape, (0, 1), kind) for x, kind in ways]
            there, back = self._plans[key]
            with there:
                spectrum[...] = self._fft.rfft2(image)
            spectrum *= transfer
            with back:
                image[...] = self._fft.irfft2(spectrum, s=image.shape)

    def take(self, table: Array, index: Array, out: Array) -> None:
        self.xp.take(table, index, out=out)

    def to_host(self, x: Array) -> np.ndarray:
        return np.asarray(self.xp.asnumpy(x))

    def recorded(self, work: Work) -> Work:
        return Recorded(work, self._cuda)

    def number(self, x: Any) -> Number:
        return x

    def floats(self, *numbers: Number) -> tuple[float, ...]:
        xp = self.xp
        return tuple(self.to_host(xp.stack([xp.asarray(n, np.float64) for n in numbers])).tolist())

    def dot(self, a: Array, b: Array, weight: Array | None = None) -> Number:
        return self.total(a * b if weight is None else a * b * weight)

    def total(self, x: Array) -> Number:
        # Of rows first: many blocks of threads work on many sums, and one on a single sum.
        return x.sum(-1).sum()

    def mean(self, x: Array) -> Number:
        return self.total(x) / x.size


class Recorded:
    """Work on a GPU that is done as a whole from its third call with the same arguments on, as a CUDA graph.

    The first call finds out what the work needs: code to compile and transforms to plan. The second records it. What
    cannot be recorded is done step by step, as on the processor.

    Parameters
    ----------
    work : callable
        As in `Backend.recorded`; takes arrays and values.
    cuda : module
        `cupy.cuda`.
    """

    def __init__(self, work: Work, cuda: Any) -> None:
        self._work, self._cuda = work, cuda
        self._done: dict[Any, Callable[[], None] | None] = {}  # by arguments; None: called once
        # What the work allocates stays its own: from a common pool others would get what the graph writes to.
        self._pool = cuda.MemoryPool()

    def __call__(self, *arguments: Any) -> None:
        key = tuple((a.data.ptr, a.shape, a.strides) if hasattr(a, "strides") else a for a in arguments)
        if key not in self._done:
            self._done[key] = None
            self._work(*arguments)
            return
        launch = self._done[key]
        if launch is None:
            launch = self._done[key] = self._record(arguments) or partial(self._work, *arguments)
        launch()

    def _record(self, arguments: tuple[Any, ...]) -> Callable[[], None] | None:
        """What does the work once more, without doing it; None where a step of it cannot be recorded."""
        stream = self._cuda.Stream(non_blocking=True)
        with self._cuda.using_allocator(self._pool.malloc), stream:
            stream.begin_capture()
            try:
                self._work(*arguments)
            except Exception:
                # The library raises different errors, any of which spoils the recording.
                with suppress(Exception):
                    stream.end_capture()
                return None
            return stream.end_capture().launch
