"""The light path in place: forward and adjoint for the solver's inner loop, which allocates nothing, and calibration.

This is the one deliberate second copy of `runtime.lightpath.light_path`, which defines the mathematics and says what
each array means; here it is arranged for speed. Rows that are dark and columns that the iris stops are not
transformed, and elementwise work is done on strips of rows while they are in a core's cache. A test keeps
irradiance and gradient of the two equal to 1e-9 in double precision (`tests/runtime/test_solver_optics.py`).

The panel's side is in `in_place_panel`, the image's in `in_place_image`, and the pupil between them is here.

The image is sampled once a panel pixel (fine = 1) or as finely as the path's grid, an axis. |z|^2 has twice the
bandwidth of z: once a pixel carries it where the iris passes no more than half of the panel's band.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.grid import Grid
from runtime.lightpath.light_path import LightPath
from runtime.solver.array_backend import Backend, Room
from runtime.solver.in_place_image import ImagePlane, pixel_filter
from runtime.solver.in_place_panel import Panel
from runtime.solver.iris_band import band, folded

Array = Any


def aliases(path: LightPath, fine: int) -> bool:
    """Whether the iris passes more frequencies than the image's samples tell apart."""
    grid = path.grid
    return any(2 * edge + 1 > fine * n for edge, n in zip(grid.band, grid.padded, strict=True))


class Optics:
    """From phase on the panel to irradiance at the image's pixels, and the adjoint.

    Parameters
    ----------
    path : LightPath
    fine : int
        Samples a panel pixel, an axis: 1, or those of the path's grid.
    integrate : bool
        Whether pixels integrate light over their area and the path's own irradiance filter is applied, which takes
        two more real transforms each way. Without it, `forward` gives irradiance at their centres, which the fine
        grid is not offered for.
    backend : Backend
    room : Room, optional
        Where the fields are, for paths that are used one after the other; None: room of its own.
    apart : bool
        Whether the panel's spectrum is kept apart from the image's, as `factor_adjoint` and whoever changes
        `transfers` need.

    Raises
    ------
    InputError
        For a path to the far field, and for crosstalk where the image aliases.
    """

    def __init__(
        self,
        path: LightPath,
        fine: int,
        integrate: bool,
        backend: Backend,
        room: Room | None = None,
        apart: bool = False,
    ) -> None:
        xp, grid = backend.xp, path.grid
        if path.far_field is not None:
            raise InputError("patterns for the far field are not computed: use angular_spectrum or fresnel")
        if path.crosstalk is not None and aliases(path, fine):
            raise InputError("with crosstalk and all of the panel's band open, use the fine grid")
        real, pair = path.response.dtype, path.source.dtype
        self.backend, self.shape = backend, grid.shape
        self.rows, self.columns = (
            band(edge, n, fine * n) for edge, n in zip(grid.band, grid.padded, strict=True)
        )
        room = room or Room(backend)
        self.panel = Panel(path, self.rows, self.columns, backend, room)
        # Where one buffer can be both, the pupil multiplies in place.
        self.in_place = fine == 1 and len(path.transfers) == 1 and path.crosstalk is None and not apart
        self._take_pupil(path)
        self.strongest = int(np.argmax(path.weights))
        self.spectrum = self.panel.spectrum
        if self.in_place:
            self._room = backend.column_room(self.spectrum)
        else:
            self.spectrum = room.zeros(
                "image spectrum", (fine * grid.padded[0], len(self.columns.frequencies)), pair
            )
        margin = fine * grid.margin if integrate else 0
        self.at_pixels = tuple(slice(margin, margin + fine * n, fine) for n in grid.shape)
        weights = [w for state in self.panel.states for w in state.weights]
        self.image_plane = ImagePlane(path, weights, fine, margin, self.columns, self.spectrum, backend, room)
        self.strip = self.image_plane.strip
        self.one = xp.zeros(grid.shape if len(self.panel.states) > 1 else (0, 0), real)
        self.integrate, self._fine, self._first = integrate, fine, path

    def take(self, path: LightPath) -> None:
        """Go on with another light path that differs from the one before in its source, leak and transfers alone."""
        self.panel.take(path)
        self._take_pupil(path)

    def _take_pupil(self, path: LightPath) -> None:
        xp, grid = self.backend.xp, path.grid
        transfers = self.in_band_order(
            path.transfers * (_aperture(path) / (grid.padded[0] * grid.padded[1])), grid
        )
        self.transfers = [xp.asarray(t.astype(path.source.dtype)) for t in transfers]
        self.conjugates = [t.conj() for t in self.transfers]
        self.modes = len(self.transfers)
        if self.in_place:  # they are only used in blocks
            (transfer,), (conjugate,) = self.transfers, self.conjugates
            self._blocks, self._conjugate_blocks = map(self.backend.column_blocks, (transfer, conjugate))
            self.transfers, self.conjugates = [], []

    def in_band_order(self, over_band: np.ndarray, grid: Grid) -> np.ndarray:
        """Arrays over the band [M, n, m], lowest frequency first, in the order of this path's transfer functions."""
        for axis, to in ((1, self.rows), (2, self.columns)):
            over_band = folded(over_band, axis, grid.band[axis - 1], to)
        return over_band

    @cached_property
    def _pixels(self) -> tuple[Array, Array, Array, Array]:
        """Irradiance at the image's samples, its half spectrum, and the pixels' transfer function and its conjugate.

        Made when first used: a calibration, whose camera has pixels of its own, never uses them.
        """
        xp, path = self.backend.xp, self._first
        transfer = xp.asarray(pixel_filter(path, self._fine).astype(path.source.dtype))
        image = xp.zeros(self.image_plane.shape, path.response.dtype)
        return image, xp.zeros(transfer.shape, transfer.dtype), transfer, transfer.conj()

    def forward(self, phase: Array, light: Array) -> None:
        """Fill `light` [H, W] from phase (rad) [H, W]; the fields are kept for `adjoint`."""
        if not self.integrate:
            self.irradiance(phase, light)
            return
        image, spectrum, transfer, _ = self._pixels
        self.irradiance(phase, image)
        self.backend.filter(image, transfer, spectrum)
        light[...] = image[self.at_pixels]

    def irradiance(self, phase: Array, image: Array) -> None:
        """Fill irradiance at the image's own samples, before any filter; the fields are kept for `adjoint`."""
        for state in range(len(self.panel.states)):
            self.panel.forward(phase, not self.in_place, state)
            for mode in range(self.modes):
                if self.in_place:
                    self._through_columns(self._blocks)
                else:
                    self._through_pupil(mode)
                    self.backend.columns_fft(self.spectrum, False)
                self.image_plane.forward(state * self.modes + mode, image)

    def factor_adjoint(self, phase: Array, slope: Array, factor: Array, axial: Array) -> float:
        """Add to `factor` the gradient of a loss over a factor on the field that leaves the panel; spectra are `apart`.

        Parameters
        ----------
        phase : float array [H, W], rad
            That of the last `irradiance`.
        slope : float array
            Gradient over irradiance at the image's own samples, before any filter.
        factor : complex array [H, W]
            Its real part is the gradient over the factor's logarithm, its imaginary part over its phase (rad).
        axial : float array [rows, columns of the band]
            A phase (rad) that each frequency gains in the pupil, as from `in_band_order`.

        Returns
        -------
        float
            The gradient over how many times the phase `axial` the pupil adds.
        """
        along = 0.0
        for state in range(len(self.panel.states)):
            if len(self.panel.states) > 1:
                self.panel.forward(phase, True, state)
            left = self.panel.spectrum.copy()
            for mode in range(self.modes):
                self.image_plane.adjoint(state * self.modes + mode, slope)
                self._back_through_pupil(mode, again=mode > 0)
                along += self._along(left, mode, axial)
            self.panel.factor_adjoint(phase, factor)
        return along

    def _along(self, left: Array, mode: int, axial: Array) -> float:
        """Gradient over how many times the pupil adds a phase, of one mode: Im(conj(transfer left) came) axial."""
        total = 0.0
        for run in self.panel.runs:
            spectrum, transfer = left[run.panel], self.transfers[mode][run.band]
            came, phase = self.spectrum[run.image], axial[run.band]

            def work(
                worker: int,
                rows: slice,
                spectrum: Array = spectrum,
                transfer: Array = transfer,
                came: Array = came,
                phase: Array = phase,
            ) -> tuple[float, ...]:
                there = spectrum[rows] * transfer[rows]
                turned = there.real * came[rows].imag
                turned -= there.imag * came[rows].real
                turned *= phase[rows]
                return (float(turned.sum(dtype=np.float64)),)

            total += self.backend.over_rows(len(came), self.strip, work)[0]
        return total

    def adjoint(self, phase: Array, slope: Array, gradient: Array) -> None:
        """Fill the gradient of a loss over phase from its gradient over light.

        The steps back are 2 z dI, the conjugate transfer, then the panel's part.

        Parameters
        ----------
        phase : float array [H, W], rad
            That of the last `forward`.
        slope : float array [H, W]
            Gradient over light.
        gradient : float array [H, W]
            The result.

        References
        ----------
        Chakravarthula et al. 2020, eq. 20-23.
        """
        image = self._slope_over_image(slope)
        for state in range(len(self.panel.states)):
            self._back(image, state)
            onto = gradient if state == 0 else self.one
            self.panel.adjoint(phase, onto, not self.in_place, state)
            if state > 0:
                gradient += onto

    def adjoint_wave(self, slope: Array, wave: Array) -> None:
        """Fill `wave` [H, W] with the field that reaches the panel: that of `adjoint` before it becomes phase.

        Where the panel has several states, that of the first.
        """
        self._back(self._slope_over_image(slope), 0)
        self.panel.field_from_spectrum(wave, columns=not self.in_place)

    def wave_at_panel(self, wave: Array) -> None:
        """A field at the image's pixels [H, W] to the one on the panel that makes it, in place.

        The adjoint of the strongest mode: its inverse, up to a constant, where the pupil passes all.
        """
        mode = self.strongest
        field = self.image_plane.fields[mode]
        field[...] = 0
        field[self.at_pixels] = wave
        self.image_plane.adjoint(mode, None)
        self._back_through_pupil(mode, again=False)
        self.panel.field_from_spectrum(wave, columns=not self.in_place)

    def _slope_over_image(self, slope: Array) -> Array:
        """A gradient over light [H, W] as one over the image's own samples."""
        if not self.integrate:
            return slope
        image, spectrum, _, conjugate = self._pixels
        image[...] = 0
        image[self.at_pixels] = slope
        self.backend.filter(image, conjugate, spectrum)
        return image

    def _back(self, image: Array, state: int) -> None:
        """Fill the panel's spectrum with 2 slope z of every mode of a state, back through the pupil."""
        for mode in range(self.modes):
            self.image_plane.adjoint(state * self.modes + mode, image)
            self._back_through_pupil(mode, again=mode > 0)

    def _through_columns(self, transfers: dict[int, Array]) -> None:
        """Where one buffer is both the panel's and the image's: along the columns, and through the pupil, at once."""
        xp = self.backend.xp

        def multiply(spectra: Array, transfer: Array) -> None:
            for run in self.rows.runs:
                xp.multiply(spectra[run.panel], transfer[run.band], out=spectra[run.panel])
            spectra[self.rows.image_gap] = 0

        self.backend.through_columns(self.spectrum, transfers, self._room, multiply)

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
            self._through_columns(self._conjugate_blocks)
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


def _aperture(path: LightPath) -> np.ndarray:
    """Spectrum of a pixel's, or of a sub-pixel's, active area over the band, rows and columns lowest first."""
    sub = (1, 1) if path.crosstalk is None else tuple(len(taps) for taps in path.crosstalk)
    sides = []
    for axis in (0, 1):
        cycles = np.asarray(path.grid.frequency_index(axis)) / path.grid.padded[axis]
        sides.append(np.sinc(cycles * float(path.aperture[axis]) / sub[axis]) / sub[axis])
    return np.asarray(sides[0][:, None] * sides[1][None, :])
