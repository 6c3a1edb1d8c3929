"""The panel of a simulated bench, drawn on sub-pixels: gray levels to phase, dead space, beam, dust.

Arrays are [row, column]; [H, W] is panel pixels, [qH, qW] sub-pixels. Shares run from -1 to 1 over it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.defects import (
    Convention,
    Crosstalk,
    Illumination,
    PanelWavefront,
    PhaseNonuniformity,
    PhaseResponse,
    Specks,
    Stripes,
    ZeroOrder,
)

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Complex = NDArray[np.complex64]
Complex128 = NDArray[np.complex128]


def share_grid(height: int, width: int) -> tuple[Array, Array]:
    """(y, x), [height, 1] and [1, width]: -1 to 1 from edge to edge, cell centres."""
    y = (2 * np.arange(height) + 1) / height - 1
    x = (2 * np.arange(width) + 1) / width - 1
    return y[:, None], x[None, :]


class Drive:
    """Gray levels to phase on sub-pixels, for one channel, and the derivative back.

    A pixel's phase is sign * thickness(x, y) * 2 pi gain s(gray / levels); a fringing field smears the profile.
    """

    def __init__(self, bench: BenchDescription, wavelength_nm: float) -> None:
        panel = bench.panel
        self.q = bench.simulation.subpixels
        self.levels = panel.levels
        convention = bench.defect(Convention)
        self.sign = panel.phase_sign * (convention.phase_sign if convention else 1)
        self._curve = bench.defect(PhaseResponse)
        self._full = 2 * np.pi
        if self._curve:
            self._full *= (
                self._curve.gain * (self._curve.reference_nm / wavelength_nm) ** self._curve.dispersion
            )
        self._thickness = _thickness(bench.defect(PhaseNonuniformity), panel.height, panel.width)
        crosstalk = bench.defect(Crosstalk)
        self._smear_y = self._smear_x = None
        if crosstalk:
            self._smear_y = smear_weights(crosstalk.width_y_px, crosstalk.asymmetry_y, self.q)
            self._smear_x = smear_weights(crosstalk.width_x_px, crosstalk.asymmetry_x, self.q)

    @property
    def smears(self) -> bool:
        """Whether sub-pixels of one pixel differ in phase."""
        return self._smear_x is not None

    def magnitude(self, gray: NDArray[np.floating]) -> Single:
        """Phase of each pixel before its sign, rad; `gray` may be fractional."""
        return (self._full * self._thickness * self._shape(gray)).astype(np.float32)

    def slope(self, gray: NDArray[np.floating]) -> Single:
        """d magnitude / d gray, rad a gray level."""
        d = self._curve
        t = np.asarray(gray) / self.levels
        slope = np.ones_like(t)
        if d:
            slope += -d.s_curvature * np.cos(2 * np.pi * t) + np.pi * d.lopsidedness * np.sin(2 * np.pi * t)
        return (self._full * self._thickness * slope / self.levels).astype(np.float32)

    def gray_of(self, magnitude: Array) -> Array:
        """Fractional gray, 0..255, of each pixel's phase before its sign, rad; inverse of `magnitude`."""
        table = np.arange(256.0)
        return np.interp(magnitude / (self._full * self._thickness), self._shape(table), table)

    def wrapped(self, gray: Array) -> Array:
        """Gray levels in 0..255 with the phase of `gray` modulo 2 pi, or the nearest that the panel can show.

        For gradient steps that leave the panel's range by less than a wave.

        Parameters
        ----------
        gray : float64 array [H, W]

        Returns
        -------
        float64 array [H, W]
            Fractional.
        """
        table = np.linspace(0, self.levels * 1.5, 3073)
        scale = self._full * self._thickness
        waves = 2 * np.pi / scale
        flat = self._shape(table)
        period = np.interp(waves, flat, table)
        out = np.asarray(gray, np.float64)
        low, high = out < 0, out > np.minimum(period, 255.5)
        shifted = (
            self._shape(np.where(low | high, out, 0)) + np.where(low, waves, 0) - np.where(high, waves, 0)
        )
        out = np.where(low | high, np.interp(shifted, flat, table), out)
        # where the panel shows less than a wave, the far side of the gap may be nearer: split it in the middle
        return np.where(out > 255, np.where(out - 255 > period - out, 0, 255), np.clip(out, 0, 255))

    def _shape(self, gray: NDArray[np.floating]) -> Array:
        d = self._curve
        t = np.asarray(gray, np.float64) / self.levels
        if d is None:
            return t
        bend = -d.s_curvature * np.sin(2 * np.pi * t) / (2 * np.pi)
        return t + bend + d.lopsidedness * np.sin(np.pi * t) ** 2

    def spread(self, phase: Single) -> Single:
        """Phase on sub-pixels, [qH, qW], of phase a pixel, [H, W]; with the panel's sign."""
        phase = np.float32(self.sign) * phase
        if self._smear_y is None or self._smear_x is None:
            return np.repeat(np.repeat(phase, self.q, 0), self.q, 1)
        return _smear(_smear(phase, self._smear_y).T, self._smear_x).T

    def spread_adjoint(self, phase: Single) -> Single:
        """Adjoint of `spread`: [qH, qW] to [H, W]."""
        h, w = phase.shape
        if self._smear_y is None or self._smear_x is None:
            out = phase.reshape(h // self.q, self.q, w // self.q, self.q).sum((1, 3))
        else:
            out = _smear_adjoint(_smear_adjoint(phase.T, self._smear_x).T, self._smear_y)
        return np.float32(self.sign) * out


def _thickness(d: PhaseNonuniformity | None, height: int, width: int) -> Array:
    if d is None:
        return np.ones((1, 1))
    y, x = share_grid(height, width)
    dome = np.exp(-((x - d.dome_x_share) ** 2 + (y - d.dome_y_share) ** 2) / d.dome_radius_share**2)
    ripple = np.sin(2.6 * np.pi * (0.8 * x + 0.6 * y) + 0.7)
    shape = d.wedge * (x + 0.4 * y) + d.dome * (dome - dome.mean()) + d.ripple * ripple
    return np.clip(1 + shape, 0.05, None)


def smear_weights(width_px: float, asymmetry: float, q: int) -> Array:
    """Weights of a pixel's neighbours in the phase of each sub-pixel; rows sum to 1.

    The kernel is a two-sided exponential of decay lengths width (1 +/- asymmetry), integrated exactly over
    pixels and averaged over each sub-pixel.

    Parameters
    ----------
    width_px : float, pixels
    asymmetry : float
        -1 to 1.
    q : int
        Sub-pixels across a pixel.

    Returns
    -------
    float64 array [q, 2 R + 1]
    """
    after, before = max(width_px * (1 + asymmetry), 1e-6), max(width_px * (1 - asymmetry), 1e-6)

    def cumulative(t: Array) -> Array:
        total = after + before
        left = before / total * np.exp(np.minimum(t, 0) / before)
        right = 1 - after / total * np.exp(-np.maximum(t, 0) / after)
        return np.where(t < 0, left, right)

    reach = max(1, int(np.ceil(12 * max(after, before))))
    fine = 32
    x = (np.arange(q * fine) + 0.5) / (q * fine) - 0.5
    j = np.arange(-reach, reach + 1)
    weights = cumulative(x[:, None] - j + 0.5) - cumulative(x[:, None] - j - 0.5)
    weights = weights.reshape(q, fine, -1).mean(1)
    return weights / weights.sum(1, keepdims=True)


def _smear(a: Single, weights: Array) -> Single:
    """[n, m] to [q n, m] along the first axis; edges continue outwards."""
    q, taps = weights.shape
    n = a.shape[0]
    wide = np.pad(a, ((taps // 2, taps // 2), (0, 0)), mode="edge")
    out = np.zeros((n, q, a.shape[1]), np.float32)
    for k in range(q):
        for j in range(taps):
            out[:, k] += np.float32(weights[k, j]) * wide[j : j + n]
    return out.reshape(n * q, a.shape[1])


def _smear_adjoint(a: Single, weights: Array) -> Single:
    q, taps = weights.shape
    r = taps // 2
    parts = a.reshape(a.shape[0] // q, q, a.shape[1])
    n = parts.shape[0]
    wide = np.zeros((n + 2 * r, a.shape[1]), np.float32)
    for k in range(q):
        for j in range(taps):
            wide[j : j + n] += np.float32(weights[k, j]) * parts[:, k]
    wide[r] += wide[:r].sum(0)
    wide[n + r - 1] += wide[n + r :].sum(0)
    return wide[r : n + r]


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
        beam = beam_amplitude(bench.defect(Illumination), h * q, w * q)
        fill = leak.fill_factor if leak else bench.panel.fill_factor
        active = active_area(fill, q)
        covered = np.tile(active, (h, w))
        amplitude = beam * _stripes(bench.defect(Stripes), w, q)
        path = panel_path_nm(bench.defect(PanelWavefront), h * q, w * q, w / h)
        surface = amplitude * np.exp(2j * np.pi * path / wavelength_nm) * _dust(bench.defect(Specks), h, w, q)
        self.lit: Complex = (surface * covered).astype(np.complex64)
        self.dark = leak is None
        self.unlit: Complex = np.zeros((1, 1), np.complex64)
        if leak:
            dead = leak.dead_amplitude * np.exp(1j * np.deg2rad(leak.dead_phase_deg))
            cycles = bench.panel.pitch_um / wavelength_nm  # 1 mrad, in cycles a pixel
            tilt = tilt_factor(
                (h, w), q, (leak.surface_tilt_y_mrad * cycles, leak.surface_tilt_x_mrad * cycles)
            )
            first = leak.surface_amplitude * np.exp(1j * np.deg2rad(leak.surface_phase_deg))
            self.unlit = (surface * (1 - covered) * dead + beam * first * tilt).astype(np.complex64)


def active_area(fill_factor: float, q: int) -> Array:
    """Share of each sub-pixel's area that is active, [q, q]: a centred square of side sqrt(fill_factor)."""
    side = np.sqrt(fill_factor)
    edges = np.linspace(-0.5, 0.5, q + 1)
    covered = np.clip(np.minimum(edges[1:], side / 2) - np.maximum(edges[:-1], -side / 2), 0, None) * q
    return covered[:, None] * covered[None, :]


def tilt_factor(shape: tuple[int, int], q: int, cycles_a_pixel: tuple[float, float]) -> Complex128:
    """exp(2 pi j f . x) on sub-pixels, about the panel's centre; f is (fy, fx) in cycles a pixel."""
    y, x = share_grid(shape[0] * q, shape[1] * q)
    turn_y = np.exp(2j * np.pi * cycles_a_pixel[0] * y * shape[0] / 2)
    turn_x = np.exp(2j * np.pi * cycles_a_pixel[1] * x * shape[1] / 2)
    return turn_y * turn_x


def beam_amplitude(d: Illumination | None, height: int, width: int) -> Array:
    """Amplitude of the beam over the panel; its mean square is 1."""
    if d is None:
        return np.ones((1, 1))
    y, x = share_grid(height, width)
    r2 = ((x - d.centre_x_share) / d.waist_x_share) ** 2 + ((y - d.centre_y_share) / d.waist_y_share) ** 2
    amplitude = np.exp(-r2) * (1 + d.ring * np.cos(9 * r2 + 1))
    return amplitude / np.sqrt(np.mean(amplitude**2))


def panel_path_nm(d: PanelWavefront | None, height: int, width: int, aspect: float) -> Array:
    """Path difference over the panel, nm, [height, width]: a saddle, a bend, a trefoil and a dent."""
    if d is None:
        return np.zeros((1, 1))
    y, x = share_grid(height, width)
    y = y / aspect
    turn = np.deg2rad(d.orientation_deg)
    a, b = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    dent = np.exp(-((x + 0.4) ** 2 + (y - 0.2) ** 2) / 0.08)
    path = (a**2 - 0.8 * b**2) + 0.25 * (a**3 - 3 * a * b**2) + 0.15 * np.cos(3 * a + b) - 0.12 * dent
    return d.peak_to_valley_nm * path / np.ptp(path)


def _stripes(d: Stripes | None, width: int, q: int) -> Array:
    if d is None:
        return np.ones((1, 1))
    columns = 1 + d.rms * np.random.default_rng([d.places, 17]).standard_normal(width)
    return np.repeat(np.clip(columns, 0, None), q)[None, :]


def _dust(d: Specks | None, height: int, width: int, q: int) -> Complex128:
    if d is None:
        return np.ones((1, 1), np.complex128)
    rng = np.random.default_rng([d.places, 29])
    out = np.ones((height * q, width * q), np.complex128)
    inside = d.transmission * np.exp(1j * np.deg2rad(d.phase_deg))
    y = (np.arange(height * q) + 0.5)[:, None] / q
    x = (np.arange(width * q) + 0.5)[None, :] / q
    for _ in range(d.count):
        cy, cx = rng.uniform(0, height), rng.uniform(0, width)
        radius = d.smallest_radius_px * (d.largest_radius_px / d.smallest_radius_px) ** rng.uniform()
        covered = np.clip((radius - np.hypot(y - cy, x - cx)) * q + 0.5, 0, 1)
        out *= 1 + covered * (inside - 1)
    return out
