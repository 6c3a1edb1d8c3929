"""The surface of a simulated panel, drawn on sub-pixels: dead space, beam, wavefront, stripes, dust.

Arrays are [row, column]; [H, W] is panel pixels, [qH, qW] sub-pixels. Shares run from -1 to 1 over it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.defects import (
    Illumination,
    PanelWavefront,
    Specks,
    Stripes,
    ZeroOrder,
)
from firmware_iface.virtual.measured_field import MeasuredField, measured_field
from firmware_iface.virtual.rough_surface import rough_surface

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Complex = NDArray[np.complex64]
Complex128 = NDArray[np.complex128]


REFERENCE_NM = 520.0  # wavelength at which phases of path differences are given


def share_grid(height: int, width: int) -> tuple[Array, Array]:
    """(y, x), [height, 1] and [1, width]: -1 to 1 from edge to edge, cell centres."""
    y = (2 * np.arange(height) + 1) / height - 1
    x = (2 * np.arange(width) + 1) / width - 1
    return y[:, None], x[None, :]


class Surface:
    """The panel without its pattern: field = lit * exp(j phase) + unlit, on sub-pixels.

    Attributes
    ----------
    lit, unlit : complex64 array [qH, qW]
        For a beam of unit mean irradiance; unlit is [1, 1] where `dark`.
    dark : bool
        Whether no light is unmodulated.
    """

    def __init__(self, bench: BenchDescription, wavelength_nm: float) -> None:
        h, w, q = bench.panel.height, bench.panel.width, bench.simulation.subpixels
        leak = bench.defect(ZeroOrder)
        measured, turn = measured_field(bench.defect(MeasuredField), wavelength_nm, h * q, w * q)
        beam = beam_amplitude(bench.defect(Illumination), h * q, w * q) * measured
        fill = leak.fill_factor if leak else bench.panel.fill_factor
        covered = np.tile(active_area(fill, q), (1, w))  # of one row of pixels
        stripes = _stripes(bench.defect(Stripes), h, w, q)
        path = panel_path_nm(bench.defect(PanelWavefront), h * q, w * q, w / h)
        dust = _dust(bench.defect(Specks), h, w, q)
        self.dark = leak is None
        self.lit: Complex = np.empty((h * q, w * q), np.complex64)
        self.unlit: Complex = np.zeros((1, 1) if leak is None else (h * q, w * q), np.complex64)
        if leak:
            dead = leak.dead_amplitude * np.exp(1j * np.deg2rad(leak.dead_phase_deg))
            cycles = bench.panel.pitch_um / wavelength_nm  # 1 mrad, in cycles a pixel
            tilt_y, tilt_x = tilt_turns(
                (h, w), q, (leak.surface_tilt_y_mrad * cycles, leak.surface_tilt_x_mrad * cycles)
            )
            first = leak.surface_amplitude * np.exp(1j * np.deg2rad(leak.surface_phase_deg))
        for block in _blocks(h * q, w * q, q):
            beam_here, stripes_here, turn_here, path_here, dust_here = (
                a if len(a) == 1 else a[block] for a in (beam, stripes, turn, path, dust)
            )
            covered_here = np.tile(covered, ((block.stop - block.start) // q, 1))
            surface = beam_here * stripes_here * turn_here * np.exp(2j * np.pi / wavelength_nm * path_here)
            surface = surface * dust_here
            self.lit[block] = surface * covered_here
            if leak:
                reflected = beam_here * first * (tilt_y[block] * tilt_x)
                self.unlit[block] = surface * (1 - covered_here) * dead + reflected


def _blocks(height: int, width: int, multiple: int = 1) -> Iterator[slice]:
    """Rows of a large array, some at a time and a multiple of that many: what is needed on the way stays small."""
    step = multiple * max(1, 2**19 // (width * multiple))
    for k in range(0, height, step):
        yield slice(k, min(k + step, height))


def active_area(fill_factor: float, q: int) -> Array:
    """Share of each sub-pixel's area that is active, [q, q]: a centred square of side sqrt(fill_factor).

    A sub-pixel that the square's edge cuts lights up as a whole, so the square would come out too wide (of a fill
    factor of 0.7, 0.006 of the picture's variance with four sub-pixels). These weights leave its second moment right,
    too, and so its diffraction within the panel's band (0.00003). Sub-pixels in the middle have a little more than 1.
    """
    side = np.sqrt(fill_factor)
    edges = np.linspace(-0.5, 0.5, q + 1)
    covered = np.clip(np.minimum(edges[1:], side / 2) - np.maximum(edges[:-1], -side / 2), 0, None) * q
    square = ((edges[1:] + edges[:-1]) / 2) ** 2
    bendable = np.ptp(square[covered > 0]) > 1e-9  # not where all centres are as far from the middle
    if fill_factor < 1 and bendable:
        moments = np.array([covered, covered * square]) @ np.array([np.ones(q), square]).T
        wanted = q * side * np.array([1, side**2 / 12 - 1 / (12 * q**2)])
        constant, bend = np.linalg.solve(moments, wanted)
        covered = covered * (constant + bend * square)
    return covered[:, None] * covered[None, :]


def tilt_factor(shape: tuple[int, int], q: int, cycles_a_pixel: tuple[float, float]) -> Complex128:
    """exp(2 pi j f . x) on sub-pixels, about the panel's centre; f is (fy, fx) in cycles a pixel."""
    turn_y, turn_x = tilt_turns(shape, q, cycles_a_pixel)
    return turn_y * turn_x


def tilt_turns(
    shape: tuple[int, int], q: int, cycles_a_pixel: tuple[float, float]
) -> tuple[Complex128, Complex128]:
    """The two factors of `tilt_factor`, [qH, 1] and [1, qW]."""
    y, x = share_grid(shape[0] * q, shape[1] * q)
    turn_y = np.exp(2j * np.pi * cycles_a_pixel[0] * y * shape[0] / 2)
    turn_x = np.exp(2j * np.pi * cycles_a_pixel[1] * x * shape[1] / 2)
    return turn_y, turn_x


def beam_amplitude(d: Illumination | None, height: int, width: int) -> Array:
    """Amplitude of the beam over the panel; its mean square is 1."""
    if d is None:
        return np.ones((1, 1))
    y, x = share_grid(height, width)
    y, x = ((y - d.centre_y_share) / d.waist_y_share) ** 2, ((x - d.centre_x_share) / d.waist_x_share) ** 2
    amplitude = np.empty((height, width))
    for block in _blocks(height, width):
        r2 = y[block] + x
        amplitude[block] = np.exp(-r2) * (1 + d.ring * np.cos(9 * r2 + 1))
    if d.rough_rms:
        nodes = (d.rough_nodes_y, d.rough_nodes_x)
        amplitude *= np.exp(d.rough_rms * rough_surface(nodes, d.rough_seed, height, width))
    amplitude /= np.sqrt(np.mean(amplitude**2))
    return amplitude


def panel_path_nm(d: PanelWavefront | None, height: int, width: int, aspect: float) -> Array:
    """Path difference over the panel, nm, [height, width]: a saddle, a bend, a trefoil, a dent, and roughness."""
    if d is None:
        return np.zeros((1, 1))
    y, x = share_grid(height, width)
    y = y / aspect
    turn = np.deg2rad(d.orientation_deg)
    path = np.empty((height, width))
    for block in _blocks(height, width):
        a = x * np.cos(turn) + y[block] * np.sin(turn)
        b = y[block] * np.cos(turn) - x * np.sin(turn)
        a2, b2 = a * a, b * b
        dent = np.exp(-((y[block] - 0.2) ** 2) / 0.08) * np.exp(-((x + 0.4) ** 2) / 0.08)
        path[block] = (a2 - 0.8 * b2) + 0.25 * a * (a2 - 3 * b2) + 0.15 * np.cos(3 * a + b) - 0.12 * dent
    path *= d.peak_to_valley_nm / np.ptp(path)
    if d.rough_rms_rad:
        rough = rough_surface((d.rough_nodes_y, d.rough_nodes_x), d.rough_seed, height, width)
        path += d.rough_rms_rad * REFERENCE_NM / (2 * np.pi) * rough
    return path


def _stripes(d: Stripes | None, height: int, width: int, q: int) -> Array:
    if d is None:
        return np.ones((1, 1))
    errors = d.rms * np.random.default_rng([d.places, 17]).standard_normal(width)
    rows = 1 + d.fade * share_grid(height * q, 1)[0] if d.fade else np.ones((1, 1))
    return np.clip(1 + rows * np.repeat(errors, q)[None, :], 0, None)


def disc_gain(d: Specks | None, height: int, width: int) -> Array:
    """The phase's gain over the panel's pixels where discs have one of their own, [height, width]."""
    if d is None or d.phase_gain == 1:
        return np.ones((1, 1))
    gain = np.ones((height, width))
    for covered in discs(d, height, width, 4):
        gain *= 1 + covered.reshape(height, 4, width, 4).mean((1, 3)) * (d.phase_gain - 1)
    return gain


def _dust(d: Specks | None, height: int, width: int, q: int) -> Complex128:
    if d is None:
        return np.ones((1, 1), np.complex128)
    out = np.ones((height * q, width * q), np.complex128)
    inside = d.transmission * np.exp(1j * np.deg2rad(d.phase_deg))
    for covered in discs(d, height, width, q):
        out *= 1 + covered * (inside - 1)
    return out


def discs(d: Specks, height: int, width: int, q: int) -> Iterator[Array]:
    """Share of each sub-pixel that each disc covers, [height q, width q]."""
    rng = np.random.default_rng([d.places, 29])
    y = (np.arange(height * q) + 0.5)[:, None] / q
    x = (np.arange(width * q) + 0.5)[None, :] / q
    for _ in range(d.count):
        cy, cx = rng.uniform(0, height), rng.uniform(0, width)
        radius = d.smallest_radius_px * (d.largest_radius_px / d.smallest_radius_px) ** rng.uniform()
        yield np.clip((radius - np.hypot(y - cy, x - cx)) * q + 0.5, 0, 1)
