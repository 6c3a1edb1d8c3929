"""The simulated bench's light: gray levels in, irradiance out, and the gradient back.

Each mode (a spectral line of a source point) travels coherently; irradiances add. A panel of unit
reflectance, lit by a beam of mean irradiance 1, gives about 1. No code is shared with the fitted light path.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError
from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.defects import (
    Convention,
    Distance,
    PupilAberration,
    SpatialCoherence,
    TemporalCoherence,
)
from firmware_iface.virtual.further_defects import CoherentGhost, LaserAlignment, SourceLines
from firmware_iface.virtual.iris_opening import iris_opening
from firmware_iface.virtual.simulated_drive import Component, Drive, Moment
from firmware_iface.virtual.simulated_panel import REFERENCE_NM, Surface, tilt_factor
from firmware_iface.virtual.subpixel_propagation import Band, walk_px

Single = NDArray[np.float32]
Complex = NDArray[np.complex64]
Pullback = Callable[[Single], NDArray[np.float64]]

# The tails of the iris's own figure need more border the smaller it is: so many periods of the frequency at its edge,
# beyond those of an open iris. A slit may be of no width; its border ends with that of the least half width.
FIGURE_PERIODS, LEAST_HALF = 24, 0.02


@dataclass(frozen=True)
class SpectralLine:
    """One spectral line.

    Attributes
    ----------
    wavelength_nm : float, nm
    share : float
        Of the power.
    transfer : complex64 array [Fy, Fx]
        Transfer function over the band.
    """

    wavelength_nm: float
    share: float
    transfer: Complex


class OpticalPath:
    """Panel to image plane for one channel and one plane: geometry, spectral lines, source points."""

    def __init__(self, bench: BenchDescription, channel: str, plane_mm: float) -> None:
        wavelength = bench.channel(channel).wavelength_nm
        laser = [c.name for c in bench.channels].index(channel)
        offset, convention = bench.defect(Distance), bench.defect(Convention)
        distance = plane_mm + (offset.offset_mm if offset else 0.0)
        if convention:
            distance *= convention.distance_sign
        opening = iris_opening(bench)
        half_band = 0.5 * (opening.reach + max(abs(opening.centre[0]), abs(opening.centre[1])))
        ghost = bench.defect(CoherentGhost)
        q, pitch = bench.simulation.subpixels, bench.panel.pitch_um
        border = 16 + bench.simulation.padding * walk_px(wavelength, pitch, distance, half_band)
        border += max(FIGURE_PERIODS * 2 * (1 / max(min(opening.half), LEAST_HALF) - 1), 0.0)
        if ghost:
            border += max(abs(ghost.shift_y_px), abs(ghost.shift_x_px))
        self.band = Band((bench.panel.height, bench.panel.width), q, border, half_band)
        passed = opening.mask(2 * self.band.fy, 2 * self.band.fx)
        delay = relay_path_nm(bench.defect(PupilAberration), self.band)
        self.lines = [
            SpectralLine(
                wl,
                share,
                (
                    passed
                    * np.exp(2j * np.pi * delay / wl)
                    * self.band.transfer(wl, pitch, distance)
                    * second_path(ghost, self.band, wl)
                ).astype(np.complex64),
            )
            for centre, of_power in source_lines(wavelength, bench.defect(SourceLines), laser)
            for wl, share in spectral_lines(centre, bench.defect(TemporalCoherence), of_power, laser)
        ]
        to_cycles = pitch / wavelength  # 1 mrad in cycles a pixel
        points, aligned = source_points(bench.defect(SpatialCoherence)), bench.defect(LaserAlignment)
        y, x = (laser * aligned.tilt_y_mrad, laser * aligned.tilt_x_mrad) if aligned else (0.0, 0.0)
        self.tilts = [((fy + y) * to_cycles, (fx + x) * to_cycles) for fy, fx in points]
        self.wavelength_nm = wavelength


def second_path(d: CoherentGhost | None, band: Band, wavelength_nm: float) -> NDArray[np.complexfloating]:
    """Effect of a displaced and delayed copy on the field's spectrum, [Fy, Fx]."""
    if d is None:
        return np.ones((1, 1), np.complex128)
    delay = np.deg2rad(d.phase_deg) * REFERENCE_NM / wavelength_nm
    shift = band.fy[:, None] * d.shift_y_px + band.fx[None, :] * d.shift_x_px
    return np.asarray(1 + d.amplitude * np.exp(1j * (delay - 2 * np.pi * shift)))


def relay_path_nm(d: PupilAberration | None, band: Band) -> NDArray[np.float64]:
    """Path difference of the relay over the pupil, nm, [Fy, Fx]; radius 1 is the edge of the panel's band."""
    y, x = 2 * band.fy[:, None], 2 * band.fx[None, :]
    if d is None:
        return np.zeros((1, 1))
    r, t = np.hypot(y, x), np.arctan2(y, x)
    return (
        d.astigmatism_nm * r**2 * np.cos(2 * t)
        + d.oblique_astigmatism_nm * r**2 * np.sin(2 * t)
        + (3 * r**3 - 2 * r) * (d.coma_x_nm * np.cos(t) + d.coma_y_nm * np.sin(t))
        + d.spherical_nm * (6 * r**4 - 6 * r**2 + 1)
        + d.trefoil_nm * r**3 * np.cos(3 * t)
        + d.secondary_astigmatism_nm * (4 * r**4 - 3 * r**2) * np.cos(2 * t)
    )


def source_lines(wavelength_nm: float, d: SourceLines | None, laser: int) -> list[tuple[float, float]]:
    """(wavelength nm, share of the power) of a laser's lines, the nominal one first; `laser` is its number."""
    if d is None:
        return [(wavelength_nm, 1.0)]
    others, wider = ((d.separation_nm, d.share), (d.third_separation_nm, d.third_share)), 1 + laser * d.spread
    lines = [(wavelength_nm + wider * apart, share) for apart, share in others if share > 0]
    return [(wavelength_nm, 1 - d.share - d.third_share), *lines]


def spectral_lines(
    wavelength_nm: float, d: TemporalCoherence | None, power: float, laser: int
) -> list[tuple[float, float]]:
    """(wavelength nm, share) of the lines that approximate a laser's Gaussian line of this power, out to 2.5 sigma."""
    if d is None or d.lines == 1 or d.linewidth_nm == 0:
        return [(wavelength_nm, power)]
    sigma = d.linewidth_nm * (1 + laser * d.spread) / 2.3548
    at = np.linspace(-2.5, 2.5, d.lines)
    shares = np.exp(-0.5 * at**2)
    shares /= shares.sum()
    return [(wavelength_nm + float(a) * sigma, power * float(s)) for a, s in zip(at, shares, strict=True)]


def source_points(d: SpatialCoherence | None) -> list[tuple[float, float]]:
    """Directions (y, x) in mrad of equally bright points that fill the source's disc evenly."""
    if d is None or d.radius_mrad == 0:
        return [(0.0, 0.0)]
    points = [(0.0, 0.0)]
    for ring in range(1, d.rings + 1):
        # rings of 6 k points at radius k/(rings + 1/2): every point represents the same area
        n = 6 * ring
        angle = 2 * np.pi * (np.arange(n) + 0.5 * (ring % 2)) / n
        area_inside, area_outside = 1 + 3 * ring * (ring - 1), 1 + 3 * ring * (ring + 1)
        radius = d.radius_mrad * np.sqrt((area_inside + area_outside) / 2 / (1 + 3 * d.rings * (d.rings + 1)))
        points += [(float(radius * np.sin(a)), float(radius * np.cos(a))) for a in angle]
    return points


class BenchOptics:
    """A bench's light before the camera; keeps the paths used last."""

    _KEPT = 6

    def __init__(self, bench: BenchDescription) -> None:
        self.bench = bench
        self._drives: dict[str, Drive] = {}
        self._surfaces: dict[float, Surface] = {}
        self._paths: OrderedDict[tuple[str, float], OpticalPath] = OrderedDict()

    def drive(self, channel: str) -> Drive:
        """The channel's drive."""
        if channel not in self._drives:
            self._drives[channel] = Drive(self.bench, self.bench.channel(channel).wavelength_nm)
        return self._drives[channel]

    def path(self, channel: str, plane_mm: float) -> OpticalPath:
        """The channel's path to a plane."""
        key = (channel, float(plane_mm))
        if key not in self._paths:
            self._paths[key] = OpticalPath(self.bench, channel, plane_mm)
            if len(self._paths) > self._KEPT:
                self._paths.popitem(last=False)
        self._paths.move_to_end(key)
        return self._paths[key]

    def surface(self, wavelength_nm: float) -> Surface:
        """The panel's surface at a wavelength."""
        if wavelength_nm not in self._surfaces:
            if len(self._surfaces) >= 24:
                self._surfaces.clear()
            self._surfaces[wavelength_nm] = Surface(self.bench, wavelength_nm)
        return self._surfaces[wavelength_nm]

    def _turn(self, drive: Drive, phase: Single, colour: float) -> Complex:
        """exp(j phase) on sub-pixels; `colour` is the channel's wavelength over the line's."""
        if drive.smears:
            return _turn(drive.spread(phase) * np.float32(colour))
        turned = _turn(np.float32(drive.sign * colour) * phase)
        return np.repeat(np.repeat(turned, drive.q, 1), drive.q, 0)

    def turned(
        self, gray: NDArray[np.generic], before: NDArray[np.float64] | None, times: int = 1
    ) -> NDArray[np.float64] | None:
        """How far the panel has turned after some more captures, for the next one; None where it is not slow.

        Parameters
        ----------
        gray : array [H, W]
        before : float64 array [H, W], optional
            What this returned for the capture before.
        times : int
            How many.
        """
        drive = self.drive(self.bench.channels[0].name)  # a share of one wave is the same in all colours
        return drive.turned(np.asarray(gray, np.float64), before, times) if drive.slow else None

    def irradiance(
        self,
        gray: NDArray[np.generic],
        channel: str,
        plane_mm: float,
        before: NDArray[np.float64] | None = None,
    ) -> Single:
        """Irradiance samples over the padded window.

        Parameters
        ----------
        gray : array [H, W]
            Fractions allowed.
        channel : str
        plane_mm : float, mm
        before : float64 array [H, W], optional
            What `turned` returned for the capture before; None: the gray levels have been shown for long.

        Returns
        -------
        float32 array [sY, sX]
        """
        return self._run(gray, channel, plane_mm, before)

    def irradiance_and_pullback(
        self, gray: NDArray[np.generic], channel: str, plane_mm: float
    ) -> tuple[Single, Pullback]:
        """Irradiance, and its pullback.

        Parameters
        ----------
        gray : array [H, W]
            Fractions allowed.
        channel : str
        plane_mm : float, mm

        Returns
        -------
        (float32 array [sY, sX], callable)
            Irradiance samples; from d f / d irradiance [sY, sX] to d f / d gray [H, W].

        Raises
        ------
        InputError
            Where the panel is slow.
        """
        drive, path = self.drive(channel), self.path(channel, plane_mm)
        if drive.slow:
            raise InputError(
                f"bench '{self.bench.name}' cannot be differentiated: with the defect slow_response its light depends "
                "on the captures before; take the defect out of the bench."
            )
        kept: list[_Mode] = []
        irradiance = self._run(gray, channel, plane_mm, None, kept)
        levels = np.asarray(gray, np.float64)
        slope, amplitude = drive.slope(levels), drive.amplitude(levels)

        def pullback(gradient: Single) -> NDArray[np.float64]:
            size = (drive.q * gray.shape[0], drive.q * gray.shape[1])
            total, reflected = np.zeros(size, np.float32), np.zeros(size, np.float32)
            for mode in kept:
                g = path.band.field_adjoint((2 * np.float32(mode.share) * gradient) * mode.z)
                g = path.band.spectrum_adjoint(g * mode.line.transfer.conj())
                if mode.tilt is not None:
                    g = g * mode.tilt.conj()
                for turn, lit in mode.components:
                    total += turn * (g.imag * lit.real - g.real * lit.imag)
                    if drive.absorbs:
                        reflected += (g.real * lit.real + g.imag * lit.imag) / amplitude
            found = (drive.spread_adjoint(total) * slope).astype(np.float64)
            return found + drive.amplitude_adjoint(reflected, levels) if drive.absorbs else found

        return irradiance, pullback

    def _run(
        self,
        gray: NDArray[np.generic],
        channel: str,
        plane_mm: float,
        before: NDArray[np.float64] | None,
        kept: list[_Mode] | None = None,
    ) -> Single:
        """Irradiance samples; the modes are appended to `kept`."""
        drive, path = self.drive(channel), self.path(channel, plane_mm)
        levels = np.asarray(gray, np.float64)
        phase = drive.magnitude(levels, before)
        total = np.zeros(path.band.samples, np.float32)
        for line in path.lines:
            colour = path.wavelength_nm / line.wavelength_nm
            surface = self.surface(line.wavelength_nm)
            reflecting = surface.lit * drive.amplitude(levels) if drive.absorbs else surface.lit
            for moment, (number, components) in product(drive.moments, enumerate(drive.fields)):
                parts = self._parts(drive, phase, reflecting, moment, components, colour)
                field = sum((lit for _, lit in parts[1:]), parts[0][1])
                if number == 0 and not surface.dark:
                    field = field + surface.unlit
                for fy, fx in path.tilts:
                    tilt = None
                    if fy or fx:
                        tilt = tilt_factor(gray.shape, drive.q, (fy * colour, fx * colour)).astype(
                            np.complex64
                        )
                    share = line.share * moment.share / len(path.tilts)
                    spectrum = path.band.spectrum(field if tilt is None else field * tilt)
                    z = path.band.field(spectrum * line.transfer)
                    total += np.float32(share) * (z.real**2 + z.imag**2)
                    if kept is not None:
                        kept.append(_Mode(line, tilt, share, z, parts))
        return total

    def _parts(
        self,
        drive: Drive,
        phase: Single,
        reflecting: Complex,
        moment: Moment,
        components: tuple[Component, ...],
        colour: float,
    ) -> list[tuple[np.float32, Complex]]:
        """Of each component: its phase over the pattern's, and its field on sub-pixels, [qH, qW]."""
        if moment != Moment():
            phase = np.float32(moment.gain) * phase + np.float32(moment.offset_rad)
        parts = []
        for component in components:
            turn = colour * component.gain
            lit = reflecting * self._turn(drive, phase, turn)
            if component.factor != 1:
                lit = np.complex64(component.factor) * lit
            parts.append((np.float32(turn * moment.gain), lit))
        return parts


@dataclass(frozen=True)
class _Mode:
    """What the derivative needs of one field that travelled coherently."""

    line: SpectralLine
    tilt: Complex | None
    share: float
    z: Complex
    components: list[tuple[np.float32, Complex]]


def _turn(phase: Single) -> Complex:
    out = np.empty(phase.shape, np.complex64)
    out.real, out.imag = np.cos(phase), np.sin(phase)
    return out
