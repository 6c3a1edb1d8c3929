"""Where the solver's arrays live and what transforms them: NumPy here, on the CPU's cores; CuPy in `gpu_backend`.

Everything the inner loop does is in place: elementwise work goes over strips of rows that fit a core's cache, several
cores at a time; transforms write to a given array.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from runtime.lightpath import fft

Array = Any
Number = Any  # a float; on a GPU an array of no dimension, which stays there
Strip = Callable[[int, slice], "tuple[Number, ...] | None"]
Work = Callable[..., None]

STRIP_BYTES = 1 << 19  # of one row buffer: a share of a core's second-level cache
COLUMNS = 96  # of a column transform by one core


class Backend:
    """NumPy arrays, processed by all of the machine's cores.

    Attributes
    ----------
    threads : int
        Strips that are worked on at a time.
    host_cores : int
        Cores of the host for what it does itself, such as finding the motion in a video.
    """

    name = "numpy"
    xp: Any = np

    def __init__(self, threads: int = fft.THREADS) -> None:
        self.threads = self.host_cores = threads
        self.pool = ThreadPoolExecutor(threads - 1, "strips") if threads > 1 else None

    def strip_rows(self, width: int) -> int:
        """Rows of `width` complex samples in a strip."""
        return max(1, STRIP_BYTES // (8 * width))

    def over_rows(self, rows: int, size: int, work: Strip) -> tuple[Number, ...]:
        """Call `work` for all rows, in strips.

        Parameters
        ----------
        rows, size : int
            Rows in all and in a strip.
        work : callable
            Takes (worker, rows of a strip). `worker` is below `threads`, and no two calls share it at a time: it is
            the number of the row buffer to use.

        Returns
        -------
        tuple of number
            The sums of what `work` returns.
        """

        def share(worker: int) -> list[tuple[float, ...]]:
            begin, end = (rows * k // self.threads for k in (worker, worker + 1))
            done = [work(worker, slice(r, min(r + size, end))) for r in range(begin, end, size)]
            return [d for d in done if d is not None]

        others = [self.pool.submit(share, k) for k in range(1, self.threads)] if self.pool else []
        parts = share(0)
        for other in others:
            parts += other.result()
        return tuple(map(sum, zip(*parts, strict=True)))

    def rows_fft(self, x: Array, out: Array, forward: bool) -> None:
        """Unscaled DFT of each row of a strip, on the calling core alone."""
        fft.into(x, out, 1, forward, 1)

    def column_blocks(self, x: Array) -> dict[int, Array]:
        """Columns of `x` [n, m], some at a time, by the first of them, each block contiguous."""
        blocks: dict[int, Array] = {}

        def work(worker: int, columns: slice) -> None:
            blocks[columns.start] = self.xp.ascontiguousarray(x[:, columns])

        self.over_rows(x.shape[1], COLUMNS, work)
        return blocks

    def column_room(self, x: Array) -> list[Array]:
        """Room for `through_columns` of `x` [n, m]."""
        return [self.xp.empty(COLUMNS * len(x), x.dtype) for _ in range(self.threads)]

    def through_columns(
        self, x: Array, factors: dict[int, Array], room: list[Array], multiply: Callable[[Array, Array], None]
    ) -> None:
        """DFT of each column, `multiply`, inverse DFT; in place and not scaled.

        Parameters
        ----------
        x : complex array [n, m]
        factors : dict of int to array
            As from `column_blocks`.
        room : list of complex array
            As from `column_room`.
        multiply : callable
            Called with some columns' spectra, contiguous so that they stay in a core's cache, and their factors.
        """

        def work(worker: int, columns: slice) -> None:
            some = x[:, columns]
            spectra = room[worker][: some.size].reshape(some.shape)
            fft.into(some, spectra, 0, True, 1)
            multiply(spectra, factors[columns.start])
            fft.into(spectra, some, 0, False, 1)

        self.over_rows(x.shape[1], COLUMNS, work)

    def columns_fft(self, x: Array, forward: bool) -> None:
        """Unscaled DFT of each column, in place, on all cores."""
        fft.into(x, x, 0, forward, self.threads)

    def filter(self, image: Array, transfer: Array, spectrum: Array) -> None:
        """Multiply a real image by a transfer function over its half spectrum, in place; `spectrum` is room."""
        fft.filter_into(image, transfer, spectrum, self.threads)

    def take(self, table: Array, index: Array, out: Array) -> None:
        """Fill `out` with the entries of a table at indices, all of which it has."""
        np.take(table, index, out=out, mode="clip")  # another mode copies `out`

    def to_host(self, x: Array) -> np.ndarray:
        """As a NumPy array."""
        return np.asarray(x)

    def recorded(self, work: Work) -> Work:
        """`work`, for calls with the same arrays again and again: a GPU repeats what it did for them as a whole.

        `work` must leave nothing behind but what it writes to arrays that are there already, must not ask for a
        number's value, and must do the same each time that its arguments are the same arrays and the same values.
        """
        return work

    def number(self, x: Any) -> Number:
        """A number to go on computing with, where the arrays are."""
        return float(x)

    def floats(self, *numbers: Number) -> tuple[float, ...]:
        """Numbers as the host knows them; from a GPU they all come at once."""
        return tuple(map(float, numbers))

    def dot(self, a: Array, b: Array, weight: Array | None = None) -> Number:
        """Sum of a b, or of a b weight, of arrays [H, W]."""
        if weight is None:
            return float(self.xp.einsum("ij,ij->", a, b))
        return float(self.xp.einsum("ij,ij,ij->", a, b, weight))

    def total(self, x: Array) -> Number:
        """Sum of an array of any shape."""
        return float(x.sum())

    def mean(self, x: Array) -> Number:
        """Mean of an array of any shape; on a CPU to more digits than its own."""
        return float(x.mean(dtype=np.float64))


class Room:
    """Arrays that several light paths use one after the other: for each name and shape there is one."""

    def __init__(self, backend: Backend) -> None:
        self._xp, self._arrays = backend.xp, dict[Any, Array]()

    def zeros(self, name: str, shape: tuple[int, ...], dtype: Any) -> Array:
        """The array of that name, shape and type; zeros when it is first asked for."""
        key = (name, shape, np.dtype(dtype))
        if key not in self._arrays:
            self._arrays[key] = self._xp.zeros(shape, dtype)
        return self._arrays[key]
