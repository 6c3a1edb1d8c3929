"""The drive of a simulated panel: gray levels to phase on sub-pixels, and the derivative back.

Arrays are [row, column]; [H, W] is panel pixels, [qH, qW] sub-pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.defects import Convention, Crosstalk, PhaseNonuniformity, PhaseResponse
from firmware_iface.virtual.simulated_panel import share_grid

Array = NDArray[np.float64]
Single = NDArray[np.float32]


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
