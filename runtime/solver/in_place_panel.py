"""From the panel's phase to the spectrum of the light that leaves it, and back, in place."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from runtime.lightpath.light_path import LightPath, modulation_gain, states
from runtime.lightpath.modulation import factor_at, slope_at
from runtime.solver.array_backend import Backend, Room
from runtime.solver.in_place_crosstalk import Crosstalk
from runtime.solver.iris_band import Band, Run

Array = Any


class Panel:
    """The panel's side of a light path: the DFT of source exp(j phase) + leak, over the band's columns.

    Only rows that the panel has are transformed, and only columns that the iris passes are kept. The pixel's
    aperture is in the pupil's transfer functions (`Optics`). With crosstalk, the sum over sub-pixels, each at its
    place.

    Attributes
    ----------
    spectrum : complex array [rows, columns of the band]
        What `forward` fills and `adjoint` uses up.
    runs : tuple of Run
        Where the band's rows are in it.
    states : list of LightPath
        The panel's states during an exposure; one where nothing modulates the light besides its phase.
    """

    def __init__(self, path: LightPath, rows: Band, columns: Band, backend: Backend, room: Room) -> None:
        xp, grid = backend.xp, path.grid
        real, pair = path.response.dtype, path.source.dtype
        self.backend, self.rows, self.columns = backend, rows, columns
        self.take(path)
        self.shape = height, width = grid.shape
        self.strip = min(backend.strip_rows(grid.padded[1]), height)
        # source m(phase) exp(j phase); dark beyond the panel
        self.lit = room.zeros("lit", (height, grid.padded[1]), pair)
        self.row = [xp.zeros((self.strip, grid.padded[1]), pair) for _ in range(backend.threads)]
        self.part = [xp.empty((self.strip, width), real) for _ in range(backend.threads)]
        self.crosstalk = None if path.crosstalk is None else Crosstalk(path, rows, columns, backend)
        count = len(rows.frequencies) if self.crosstalk else grid.padded[0]
        self.spectrum = room.zeros("panel spectrum", (count, len(columns.frequencies)), pair)
        self.runs = rows.runs
        if self.crosstalk:  # in the band's own order, whose frequencies are each there once
            self.runs = tuple(Run(run.band, run.band, run.image, False) for run in rows.runs)

    def take(self, path: LightPath) -> None:
        """Go on with the source and leak of another path."""
        xp = self.backend.xp
        self.states, self.state = [_on(self.backend, state) for state in states(path)], 0
        self.source = None if np.all(path.source == 1) else xp.asarray(path.source)
        self.leak = None if path.leak is None else xp.asarray(path.leak)

    def forward(self, phase: Array, columns: bool = True, state: int = 0) -> None:
        """Fill `spectrum` from a phase.

        Parameters
        ----------
        phase : float array [H, W], rad
        columns : bool
            Whether the columns are transformed too; a caller may do that itself.
        state : int
            Which of `states` the panel is in.
        """
        mixing, self.state = self.crosstalk, state
        if mixing is None:
            self._rows_forward(phase, self.spectrum, None)
            if columns:
                self.backend.columns_fft(self.spectrum, True)
            return
        self.spectrum[...] = 0
        for i, down in enumerate(mixing.down):
            mixed = mixing.mix_down(phase, i)
            mixing.columns[...] = 0
            for j, across in enumerate(mixing.across):
                self._rows_forward(mixing.mix_across(mixed, j), mixing.columns, across)
            self.backend.columns_fft(mixing.columns, True)
            for run in self.rows.runs:
                self.spectrum[run.band] += mixing.columns[run.panel] * down[run.band]

    def adjoint(self, phase: Array, gradient: Array, columns: bool = True, state: int = 0) -> None:
        """Fill the gradient of a loss over phase from its gradient over `spectrum`, which is used up.

        Parameters
        ----------
        phase : float array [H, W], rad
            That of the last `forward`.
        gradient : float array [H, W]
            The result.
        columns, state
            As in `forward`.
        """
        mixing, self.state = self.crosstalk, state
        if mixing is None:
            if columns:
                self.backend.columns_fft(self.spectrum, False)
            self._rows_adjoint(self.spectrum, None, phase, gradient)
            return
        gradient[...] = 0
        for i, down in enumerate(mixing.down):
            mixed = mixing.mix_down(phase, i)
            self._back_to_columns(mixing, down)
            mixing.back[...] = 0
            for j, across in enumerate(mixing.across):
                driven = mixing.mix_across(mixed, j)
                self._light_all(driven)
                self._rows_adjoint(mixing.columns, across, driven, mixing.one)
                mixing.unmix_across(mixing.one, j, mixing.back)
            mixing.unmix_down(mixing.back, i, gradient)

    def factor_adjoint(self, phase: Array, factor: Array) -> None:
        """Add the gradient over a factor on the field that leaves the panel, from that over `spectrum`: it is used up.

        Parameters
        ----------
        phase : float array [H, W], rad
            That of the last `forward`.
        factor : complex array [H, W]
            Its real part is over the factor's logarithm, its imaginary part over its phase (rad).
        """
        mixing = self.crosstalk
        if mixing is None:
            self.backend.columns_fft(self.spectrum, False)
            self._rows_factor(self.spectrum, None, factor)
            return
        for i, down in enumerate(mixing.down):
            mixed = mixing.mix_down(phase, i)
            self._back_to_columns(mixing, down)
            for j, across in enumerate(mixing.across):
                self._light_all(mixing.mix_across(mixed, j))
                self._rows_factor(mixing.columns, across, factor)

    def _back_to_columns(self, mixing: Crosstalk, down: Array) -> None:
        """Put into `mixing.columns` what came back of the sub-row of the pixels that has the spectrum `down`."""
        mixing.columns[...] = 0
        for run in self.rows.runs:
            mixing.columns[run.panel] += self.spectrum[run.band] * down[run.band].conj()
        self.backend.columns_fft(mixing.columns, False)

    def _rows_factor(self, spectrum: Array, turned: Array | None, factor: Array) -> None:
        """Add conj(field) times the field that came back along the rows."""
        xp = self.backend.xp

        def work(worker: int, rows: slice) -> None:
            row = self._row_back(worker, rows, spectrum, turned)
            left = self.lit[rows, : self.shape[1]]
            if self.leak is not None:
                left = left + self.leak[rows]
            row *= xp.conj(left)
            factor[rows] += row

        self.backend.over_rows(self.shape[0], self.strip, work)

    def field_from_spectrum(self, field: Array, columns: bool = True) -> None:
        """Fill a field on the panel [H, W] with the adjoint (without crosstalk) of `spectrum`, which is used up."""
        spectrum = self.spectrum
        if self.crosstalk:
            spectrum = self.crosstalk.columns
            spectrum[...] = 0
            for run in self.rows.runs:
                spectrum[run.panel] += self.spectrum[run.band]
        if columns:
            self.backend.columns_fft(spectrum, False)

        def work(worker: int, rows: slice) -> None:
            field[rows] = self._row_back(worker, rows, spectrum, None)

        self.backend.over_rows(self.shape[0], self.strip, work)

    def _light_all(self, phase: Array) -> None:
        def work(worker: int, rows: slice) -> None:
            self._light(worker, rows, phase)

        self.backend.over_rows(self.shape[0], self.strip, work)

    def _light(self, worker: int, rows: slice, phase: Array, slope: bool = False) -> None:
        """source m(phase) exp(j phase): cosine and sine apart cost a fraction of a complex exponential.

        With `slope`, its derivative over phase, divided by j: source (m - j m') exp(j phase).
        """
        xp = self.backend.xp
        lit, part = self.lit[rows, : self.shape[1]], self.part[worker][: rows.stop - rows.start]
        xp.cos(phase[rows], out=part)
        lit.real[...] = part
        xp.sin(phase[rows], out=part)
        lit.imag[...] = part
        if self.source is not None:
            lit *= self.source[rows]
        path = self.states[self.state]
        if path.modulation is not None:
            here = path if path.gain is None else replace(path, gain=path.gain[rows])
            gain = modulation_gain(here)
            at = phase[rows] / gain
            factor = factor_at(path.modulation, at)
            if slope:
                factor = factor - 1j * slope_at(path.modulation, at) / gain
            lit *= factor

    def _rows_forward(self, phase: Array, spectrum: Array, turned: Array | None) -> None:
        """Write the rows' spectra over the band's columns, or add them times `turned` [columns]."""
        height, width = self.shape

        def work(worker: int, rows: slice) -> None:
            self._light(worker, rows, phase)
            row = self.row[worker][: rows.stop - rows.start]
            if self.leak is None:
                self.backend.rows_fft(self.lit[rows], row, True)
            else:
                row[:, width:] = 0
                self.backend.xp.add(self.lit[rows, :width], self.leak[rows], out=row[:, :width])
                self.backend.rows_fft(row, row, True)
            for run in self.columns.runs:
                if turned is None:
                    spectrum[rows, run.band] = row[:, run.panel]
                else:
                    spectrum[rows, run.band] += row[:, run.panel] * turned[run.band]

        spectrum[height:] = 0
        self.backend.over_rows(height, self.strip, work)

    def _row_back(self, worker: int, rows: slice, spectrum: Array, turned: Array | None) -> Array:
        """The panel's part of rows, from their spectra: adjoint of what `_rows_forward` does to a field."""
        row = self.row[worker][: rows.stop - rows.start]
        row[:, self.columns.panel_gap] = 0
        for run in self.columns.runs:
            part = spectrum[rows, run.band]
            if turned is not None:
                part = part * turned[run.band].conj()
            if run.again:
                row[:, run.panel] += part
            else:
                row[:, run.panel] = part
        self.backend.rows_fft(row, row, False)
        return row[:, : self.shape[1]]

    def _rows_adjoint(self, spectrum: Array, turned: Array | None, phase: Array, gradient: Array) -> None:
        """Re(-j exp(-j phase) ...) with the illuminating field (Chakravarthula et al. 2020, eq. 22-23)."""
        xp, modulated = self.backend.xp, self.states[self.state].modulation is not None

        def work(worker: int, rows: slice) -> None:
            row = self._row_back(worker, rows, spectrum, turned)
            xp.conjugate(row, out=row)
            if modulated:
                self._light(worker, rows, phase, slope=True)
            row *= self.lit[rows, : self.shape[1]]
            xp.negative(row.imag, out=gradient[rows])

        self.backend.over_rows(self.shape[0], self.strip, work)


def _on(backend: Backend, path: LightPath) -> LightPath:
    """A state's path with what its modulation needs in the backend's memory."""
    if path.modulation is None:
        return path
    ends, factors, shares = (backend.xp.asarray(a) for a in path.modulation)
    gain = None if path.gain is None else backend.xp.asarray(path.gain)
    return replace(path, modulation=(ends, factors, shares), gain=gain)
