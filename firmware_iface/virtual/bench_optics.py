"""The simulated bench's light: gray levels in, irradiance out, and the gradient back.

Each mode (a spectral line of a source point) travels coherently; irradiances add. A panel of unit
reflectance, lit by a beam of mean irradiance 1, gives about 1. No code is shared with the fitted light path.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.defects import (
    Convention,
    Distance,
    Iris,
    PupilAberration,
    SpatialCoherence,
    TemporalCoherence,
)
from firmware_iface.virtual.simulated_drive import Drive
from firmware_iface.virtual.simulated_panel import Surface, tilt_factor
from firmware_iface.virtual.subpixel_propagation import Band, walk_px

Single = NDArray[np.float32]
Complex = NDArray[np.complex64]
Pullback = Callable[[Single], NDArray[np.float64]]


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
        offset, convention = bench.defect(Distance), bench.defect(Convention)
        distance = plane_mm + (offset.offset_mm if offset else 0.0)
        if convention:
            distance *= convention.distance_sign
        iris = bench.defect(Iris)
        half = iris.half_width if iris else bench.iris.half_width
        centre = (iris.centre_y_share, iris.centre_x_share) if iris else (0.0, 0.0)
        half_band = 0.5 * (half + max(abs(centre[0]), abs(centre[1])))
        q, pitch = bench.simulation.subpixels, bench.panel.pitch_um
        border = 16 + bench.simulation.padding * walk_px(wavelength, pitch, distance, half_band)
        self.band = Band((bench.panel.height, bench.panel.width), q, border, half_band)
        passed = iris_mask(self.band, bench.iris.shape, half, centre)
        delay = relay_path_nm(bench.defect(PupilAberration), self.band)
        self.lines = [
            SpectralLine(
                wl,
                share,
                (passed * np.exp(2j * np.pi * delay / wl) * self.band.transfer(wl, pitch, distance)).astype(
                    np.complex64
                ),
            )
            for wl, share in spectral_lines(wavelength, bench.defect(TemporalCoherence))
        ]
        to_cycles = pitch / wavelength  # 1 mrad in cycles a pixel
        points = source_points(bench.defect(SpatialCoherence))
        self.tilts = [(fy * to_cycles, fx * to_cycles) for fy, fx in points]
        self.wavelength_nm = wavelength


def iris_mask(band: Band, shape: str, half_width: float, centre: tuple[float, float]) -> NDArray[np.bool_]:
    """Which frequencies pass, [Fy, Fx]; half_width and centre (y, x) are shares of the band, edges pass."""
    y, x = np.abs(2 * band.fy - centre[0])[:, None], np.abs(2 * band.fx - centre[1])[None, :]
    limit = half_width * (1 + 1e-9) + 1e-12
    if shape == "circle":
        return np.asarray(np.hypot(y, x) <= limit)
    return np.asarray((y <= limit) & (x <= limit))


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


def spectral_lines(wavelength_nm: float, d: TemporalCoherence | None) -> list[tuple[float, float]]:
    """(wavelength nm, share of the power) of the lines that approximate a Gaussian line, out to 2.5 sigma."""
    if d is None or d.lines == 1 or d.linewidth_nm == 0:
        return [(wavelength_nm, 1.0)]
    sigma = d.linewidth_nm / 2.3548
    at = np.linspace(-2.5, 2.5, d.lines)
    shares = np.exp(-0.5 * at**2)
    shares /= shares.sum()
    return [(wavelength_nm + float(a) * sigma, float(s)) for a, s in zip(at, shares, strict=True)]


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
        return np.repeat(np.repeat(turned, drive.q, 0), drive.q, 1)

    def irradiance(self, gray: NDArray[np.generic], channel: str, plane_mm: float) -> Single:
        """Irradiance samples over the padded window, [sY, sX], of gray levels [H, W] (fractions allowed)."""
        return self._run(gray, channel, plane_mm, keep=False)[0]

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
        """
        irradiance, modes = self._run(gray, channel, plane_mm, keep=True)
        drive, path = self.drive(channel), self.path(channel, plane_mm)
        slope = drive.slope(np.asarray(gray, np.float64))

        def pullback(gradient: Single) -> NDArray[np.float64]:
            total = np.zeros((drive.q * gray.shape[0], drive.q * gray.shape[1]), np.float32)
            for line, tilt, share, z, lit in modes:
                g = path.band.field_adjoint((2 * np.float32(share) * gradient) * z)
                g = path.band.spectrum_adjoint(g * line.transfer.conj())
                if tilt is not None:
                    g = g * tilt.conj()
                turn = np.float32(path.wavelength_nm / line.wavelength_nm)
                total += turn * (g.imag * lit.real - g.real * lit.imag)
            return (drive.spread_adjoint(total) * slope).astype(np.float64)

        return irradiance, pullback

    def _run(
        self, gray: NDArray[np.generic], channel: str, plane_mm: float, keep: bool
    ) -> tuple[Single, list[tuple[SpectralLine, Complex | None, float, Complex, Complex]]]:
        drive, path = self.drive(channel), self.path(channel, plane_mm)
        phase = drive.magnitude(np.asarray(gray, np.float64))
        total = np.zeros(path.band.samples, np.float32)
        kept = []
        for line in path.lines:
            surface = self.surface(line.wavelength_nm)
            lit = surface.lit * self._turn(drive, phase, path.wavelength_nm / line.wavelength_nm)
            field = lit if surface.dark else lit + surface.unlit
            for fy, fx in path.tilts:
                tilt = None
                if fy or fx:
                    colour = path.wavelength_nm / line.wavelength_nm
                    tilt = tilt_factor(gray.shape, drive.q, (fy * colour, fx * colour)).astype(np.complex64)
                share = line.share / len(path.tilts)
                spectrum = path.band.spectrum(field if tilt is None else field * tilt)
                z = path.band.field(spectrum * line.transfer)
                total += np.float32(share) * (z.real**2 + z.imag**2)
                if keep:
                    kept.append((line, tilt, share, z, lit))
        return total, kept


def _turn(phase: Single) -> Complex:
    out = np.empty(phase.shape, np.complex64)
    out.real, out.imag = np.cos(phase), np.sin(phase)
    return out
