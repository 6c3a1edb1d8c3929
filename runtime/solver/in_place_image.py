"""From the spectrum behind the pupil to irradiance in the image plane, and back, in place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.lightpath.light_path import LightPath
from runtime.lightpath.periodic_axis import ring
from runtime.solver.array_backend import Backend, Room
from runtime.solver.iris_band import Band

Array = Any
Window = list[tuple[slice, slice]]  # a part of the image, and where it is on the period


class ImagePlane:
    """The image's side of a light path: the rows' DFT of the band's columns, the fields, and their |z|^2.

    Parameters
    ----------
    path : LightPath
    weights : sequence of float
        Of every mode in every state of the panel.
    fine : int
        Samples a panel pixel, an axis.
    margin : int
        Samples around the panel that are part of the image.
    columns : Band
    spectrum : complex array [rows of the period, columns of the band]
        What `forward` reads, and `adjoint` writes.
    backend : Backend
    room : Room
        Where the fields are.

    Attributes
    ----------
    shape : (int, int)
        Samples of the image.
    fields : list of complex array [shape]
        Of each mode; `forward` keeps them for `adjoint`.
    """

    def __init__(
        self,
        path: LightPath,
        weights: Sequence[float],
        fine: int,
        margin: int,
        columns: Band,
        spectrum: Array,
        backend: Backend,
        room: Room,
    ) -> None:
        xp, grid = backend.xp, path.grid
        real, pair = path.response.dtype, path.source.dtype
        self.backend, self.columns, self.spectrum = backend, columns, spectrum
        padded = (fine * grid.padded[0], fine * grid.padded[1])
        height, width = (fine * n + 2 * margin for n in grid.shape)
        self.shape = (height, width)
        self.weights = [float(w) for w in weights]
        self.down, self.across = _window(margin, height, padded[0]), _window(margin, width, padded[1])
        self.dark = slice(width - margin, padded[1] - margin)  # of the period: what the window leaves out
        self.fields = [room.zeros(f"field {k}", (height, width), pair) for k in range(len(weights))]
        self.strip = min(backend.strip_rows(padded[1]), height)
        self.row = [xp.zeros((self.strip, padded[1]), pair) for _ in range(backend.threads)]
        self.part = [xp.empty((self.strip, width), real) for _ in range(backend.threads)]

    def forward(self, mode: int, image: Array) -> None:
        """Fill a mode's field from `spectrum`; its weighted |z|^2 is the image for mode 0, and is added for others."""
        xp, weight = self.backend.xp, self.weights[mode]
        for inside, period in self.down:
            spectrum, fields, light = self.spectrum[period], self.fields[mode][inside], image[inside]

            def work(
                worker: int,
                rows: slice,
                spectrum: Array = spectrum,
                fields: Array = fields,
                light: Array = light,
            ) -> None:
                count = rows.stop - rows.start
                row, part = self.row[worker][:count], self.part[worker][:count]
                row[:, self.columns.image_gap] = 0
                for run in self.columns.runs:
                    row[:, run.image] = spectrum[rows, run.band]
                self.backend.rows_fft(row, row, False)
                for here, there in self.across:
                    fields[rows, here] = row[:, there]
                here_light = light[rows] if mode == 0 else part
                xp.abs(fields[rows], out=here_light)
                here_light *= here_light
                if weight != 1:
                    here_light *= weight
                if mode > 0:
                    light[rows] += part

            self.backend.over_rows(len(fields), self.strip, work)

    def adjoint(self, mode: int, slope: Array | None) -> None:
        """Fill `spectrum` with the adjoint of `forward`.

        Parameters
        ----------
        mode : int
        slope : float array [shape] or None
            Gradient over the image: 2 weight z slope goes back. None: the field as it is goes back.
        """
        xp, twice = self.backend.xp, 2 * self.weights[mode]
        begin = 0
        for inside, period in sorted(self.down, key=lambda pair: pair[1].start):
            self.spectrum[begin : period.start] = 0
            begin = period.stop
            spectrum, fields = self.spectrum[period], self.fields[mode][inside]
            over = None if slope is None else slope[inside]

            def work(
                worker: int,
                rows: slice,
                spectrum: Array = spectrum,
                fields: Array = fields,
                over: Array | None = over,
            ) -> None:
                count = rows.stop - rows.start
                row, part = self.row[worker][:count], self.part[worker][:count]
                row[:, self.dark] = 0
                if over is not None:
                    xp.multiply(over[rows], twice, out=part)
                for here, there in self.across:
                    if over is None:
                        row[:, there] = fields[rows, here]
                    else:
                        xp.multiply(fields[rows, here], part[:, here], out=row[:, there])
                self.backend.rows_fft(row, row, True)
                for run in self.columns.runs:
                    spectrum[rows, run.band] = row[:, run.image]

            self.backend.over_rows(len(fields), self.strip, work)
        self.spectrum[begin:] = 0


def pixel_filter(path: LightPath, fine: int) -> np.ndarray:
    """Transfer function of irradiance, the path's own and a pixel's area, over the image's half spectrum."""
    height, width = (fine * (n + 2 * path.grid.margin) for n in path.grid.shape)
    fy, fx = np.fft.fftfreq(height, 1 / fine), np.fft.rfftfreq(width, 1 / fine)
    transfer = np.sinc(fy)[:, None] * np.sinc(fx)[None, :]
    own = path.irradiance_filter
    if own is None:
        return transfer
    # The same frequencies of the fine grid: the image's extent is the same.
    rows = np.rint(fy * height / fine).astype(int)
    return np.asarray(transfer * own[rows, : width // 2 + 1])


def _window(first: int, count: int, period: int) -> Window:
    """Where `count` samples that begin `first` before the panel's lie on the period: (image, period) slices."""
    window, done = [], 0
    for start, stop in ring(-first, count, period):
        window.append((slice(done, done + stop - start), slice(start, stop)))
        done += stop - start
    return window
