"""A light path made ready to be gone through many times: forward and adjoint in place, nothing allocated.

The mathematics is that of `runtime.lightpath.light_path`, which says what each array means; here it is arranged for
speed. Rows that are dark and columns that the iris stops are not transformed, and elementwise work is done on
strips of rows while they are in a core's cache.

The image is sampled once a panel pixel (fine = 1) or twice (fine = 2), an axis. |z|^2 has twice the bandwidth
of z: once a pixel carries it where the iris passes no more than half of the panel's band.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath
from runtime.lightpath.windows import ring
from runtime.solver.array_backend import Backend
from runtime.solver.band import band, folded
from runtime.solver.in_place_panel import Panel

Array = Any
Window = list[tuple[slice, slice]]  # a part of the image, and where it is on the period


def aliases(path: LightPath, fine: int) -> bool:
    """Whether the iris passes more frequencies than the image's samples tell apart."""
    grid = path.grid
    return any(2 * edge + 1 > fine * n for edge, n in zip(grid.band, grid.padded, strict=True))


class Optics:
    """From phase on the panel to irradiance at the image's pixels, and the adjoint.

    integrate: whether pixels integrate light over their area and the path's own irradiance filter is applied,
    which takes two more real transforms each way; without it, `forward` gives irradiance at their centres,
    which the fine grid is not offered for.
    Raises InputError for a path to the far field, and for crosstalk where the image aliases.
    """

    def __init__(self, path: LightPath, fine: int, integrate: bool, backend: Backend) -> None:
        xp, grid = backend.xp, path.grid
        if path.far_field is not None:
            raise InputError("patterns for the far field are not computed: use angular_spectrum or fresnel")
        if path.crosstalk is not None and aliases(path, fine):
            raise InputError("with crosstalk and all of the panel's band open, use the fine grid")
        real, pair = path.response.dtype, path.source.dtype
        self.backend, self.shape = backend, grid.shape
        padded = (fine * grid.padded[0], fine * grid.padded[1])
        self.rows, self.columns = (
            band(edge, n, fine * n) for edge, n in zip(grid.band, grid.padded, strict=True)
        )
        self.panel = Panel(path, self.rows, self.columns, backend)
        transfers = path.transfers * (_aperture(path) / (grid.padded[0] * grid.padded[1]))
        for axis, to in ((1, self.rows), (2, self.columns)):
            transfers = folded(transfers, axis, grid.band[axis - 1], to)
        self.transfers = [xp.asarray(t.astype(pair)) for t in transfers]
        self.conjugates = [t.conj() for t in self.transfers]
        self.weights = [float(w) for w in path.weights]
        self.strongest = int(np.argmax(path.weights))

        first = fine * grid.margin if integrate else 0
        height, width = (fine * n + 2 * first for n in grid.shape)
        self.at_pixels = tuple(slice(first, first + fine * n, fine) for n in grid.shape)
        self.down, self.across = _window(first, height, padded[0]), _window(first, width, padded[1])
        self.dark = slice(width - first, padded[1] - first)  # of the period: what the window leaves out
        self.fields = [xp.zeros((height, width), pair) for _ in transfers]
        # Where one buffer can be both, the pupil multiplies in place.
        self.in_place = fine == 1 and len(transfers) == 1 and path.crosstalk is None
        self.spectrum = self.panel.spectrum
        if not self.in_place:
            self.spectrum = xp.zeros((padded[0], len(self.columns.frequencies)), pair)
        self.strip = min(backend.strip_rows(padded[1]), height)
        self.row = [xp.zeros((self.strip, padded[1]), pair) for _ in range(backend.threads)]
        self.part = [xp.empty((self.strip, width), real) for _ in range(backend.threads)]
        self.image = None
        if integrate:
            transfer = xp.asarray(pixel_filter(path, fine).astype(pair))
            self.filter, self.filter_back = transfer, transfer.conj()
            self.image = xp.zeros((height, width), real)
            self.half_spectrum = xp.zeros(transfer.shape, pair)

    def forward(self, phase: Array, light: Array) -> None:
        """Fill `light` [H, W] from phase (rad) [H, W]; the fields are kept for `adjoint`."""
        image = light if self.image is None else self.image
        self.panel.forward(phase, columns=not self.in_place)
        for mode in range(len(self.transfers)):
            if self.in_place:
                self._through_columns(self.transfers[mode])
            else:
                self._through_pupil(mode)
                self.backend.columns_fft(self.spectrum, False)
            self._onto_image(mode, image)
        if self.image is not None:
            self.backend.filter(image, self.filter, self.half_spectrum)
            light[...] = image[self.at_pixels]

    def adjoint(self, phase: Array, slope: Array, gradient: Array) -> None:
        """Fill `gradient` [H, W], of a loss over phase, from `slope` [H, W], its gradient over light.

        Seed eq. 20-23: 2 z dI, back through the conjugate transfer, then the panel's part. `phase` is that of
        the last `forward`.
        """
        self._back(slope)
        self.panel.adjoint(phase, gradient, columns=not self.in_place)

    def adjoint_wave(self, slope: Array, wave: Array) -> None:
        """Fill `wave` [H, W] with the field that reaches the panel: that of `adjoint` before it becomes phase."""
        self._back(slope)
        self.panel.field_from_spectrum(wave, columns=not self.in_place)

    def wave_at_panel(self, wave: Array) -> None:
        """A field at the image's pixels [H, W] to the one on the panel that it comes from, in place.

        The adjoint of the strongest mode: its inverse, up to a constant, where the pupil passes all.
        """
        mode = self.strongest
        self.fields[mode][...] = 0
        self.fields[mode][self.at_pixels] = wave
        self._off_image(mode, None)
        self._back_through_pupil(mode, again=False)
        self.panel.field_from_spectrum(wave, columns=not self.in_place)

    def _back(self, slope: Array) -> None:
        """2 slope z of every mode, back to the panel's spectrum."""
        image = slope
        if self.image is not None:
            image = self.image
            image[...] = 0
            image[self.at_pixels] = slope
            self.backend.filter(image, self.filter_back, self.half_spectrum)
        for mode in range(len(self.transfers)):
            self._off_image(mode, image)
            self._back_through_pupil(mode, again=mode > 0)

    def _onto_image(self, mode: int, image: Array) -> None:
        """The rows' inverse DFT, the field in the window, and its weighted |z|^2 put into or added to the image."""
        xp, weight = self.backend.xp, self.weights[mode]
        for seen, period in self.down:
            spectrum, fields, light = self.spectrum[period], self.fields[mode][seen], image[seen]

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

    def _off_image(self, mode: int, slope: Array | None) -> None:
        """Adjoint of `_onto_image`: 2 weight z slope (the field as it is where there is no slope) to `spectrum`."""
        xp, twice = self.backend.xp, 2 * self.weights[mode]
        begin = 0
        for seen, period in sorted(self.down, key=lambda pair: pair[1].start):
            self.spectrum[begin : period.start] = 0
            begin = period.stop
            spectrum, fields = self.spectrum[period], self.fields[mode][seen]
            over = None if slope is None else slope[seen]

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

    def _through_columns(self, transfer: Array) -> None:
        """Where one buffer is both the panel's and the image's: along the columns, and through the pupil, at once."""
        spectrum, xp = self.spectrum, self.backend.xp

        def multiply(columns: slice) -> None:
            for run in self.rows.runs:
                part = spectrum[run.panel, columns]
                xp.multiply(part, transfer[run.band, columns], out=part)
            spectrum[self.rows.image_gap, columns] = 0

        self.backend.through_columns(spectrum, multiply)

    def _through_pupil(self, mode: int) -> None:
        """The panel's spectrum times a transfer function, onto the image's DFT."""
        xp = self.backend.xp
        for run in self.panel.runs:
            spectrum, transfer = self.panel.spectrum[run.panel], self.transfers[mode][run.band]
            out = self.spectrum[run.image]

            def work(
                worker: int,
                rows: slice,
                spectrum: Array = spectrum,
                transfer: Array = transfer,
                out: Array = out,
            ) -> None:
                xp.multiply(spectrum[rows], transfer[rows], out=out[rows])

            self.backend.over_rows(len(out), self.strip, work)
        self.spectrum[self.rows.image_gap] = 0

    def _back_through_pupil(self, mode: int, again: bool) -> None:
        """Adjoint of columns' inverse DFT and `_through_pupil`; `again`: added to the panel's spectrum."""
        if self.in_place:
            self._through_columns(self.conjugates[mode])
            return
        xp = self.backend.xp
        self.backend.columns_fft(self.spectrum, True)
        for run in self.panel.runs:
            spectrum, conjugate = self.spectrum[run.image], self.conjugates[mode][run.band]
            out, add = self.panel.spectrum[run.panel], again or run.again

            def work(
                worker: int,
                rows: slice,
                spectrum: Array = spectrum,
                conjugate: Array = conjugate,
                out: Array = out,
                add: bool = add,
            ) -> None:
                if add:
                    out[rows] += spectrum[rows] * conjugate[rows]
                else:
                    xp.multiply(spectrum[rows], conjugate[rows], out=out[rows])

            self.backend.over_rows(len(out), self.strip, work)
        if self.panel.crosstalk is None:
            self.panel.spectrum[self.rows.panel_gap] = 0


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


def _aperture(path: LightPath) -> np.ndarray:
    """Spectrum of a pixel's, or of a sub-pixel's, active area over the band, rows and columns lowest first."""
    sub = (1, 1) if path.crosstalk is None else tuple(len(taps) for taps in path.crosstalk)
    sides = []
    for axis in (0, 1):
        cycles = np.asarray(path.grid.frequency_index(axis)) / path.grid.padded[axis]
        sides.append(np.sinc(cycles * float(path.aperture[axis]) / sub[axis]) / sub[axis])
    return np.asarray(sides[0][:, None] * sides[1][None, :])
