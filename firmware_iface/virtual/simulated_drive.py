"""The drive of a simulated panel: gray levels to phase and amplitude on sub-pixels, and the derivative back.

Arrays are [row, column]; [H, W] is panel pixels, [qH, qW] sub-pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.defects import Convention, Crosstalk, PhaseNonuniformity, PhaseResponse, Specks
from firmware_iface.virtual.further_defects import (
    AmplitudeModulation,
    Drivers,
    PhaseRipple,
    PolarisationLeak,
    SlowResponse,
)
from firmware_iface.virtual.simulated_panel import disc_gain, share_grid

Array = NDArray[np.float64]
Single = NDArray[np.float32]


@dataclass(frozen=True)
class Moment:
    """One share of an exposure, in which the phase is gain * phase + offset."""

    gain: float = 1.0
    offset_rad: float = 0.0
    share: float = 1.0


@dataclass(frozen=True)
class Component:
    """One component of the field that the panel reflects: factor * exp(j gain * phase)."""

    gain: float = 1.0
    factor: complex = 1.0


class Drive:
    """Gray levels to phase and amplitude on sub-pixels, for one channel, and the derivative back.

    A pixel's phase is sign * (thickness(x, y) * 2 pi gain s(gray / levels) + offset(x, y)); a fringing field smears
    the profile. Its amplitude depends on the gray level asked for, and is smeared likewise.

    Attributes
    ----------
    moments : tuple of Moment
        Parts of an exposure; their irradiances add.
    fields : tuple of tuple of Component
        Fields whose irradiances add, each the sum of components. The first holds the pattern's own.
    """

    def __init__(self, bench: BenchDescription, wavelength_nm: float) -> None:
        panel = bench.panel
        self.q = bench.simulation.subpixels
        self.levels = panel.levels
        self._own: Array | None = None  # the gray level shown for each of 0 to 255
        if panel.gray_levels:
            own = np.array(panel.gray_levels)
            turns = (np.arange(256)[:, None] - own) / panel.levels
            self._own = own[np.abs(turns - np.rint(turns)).argmin(1)]
        convention = bench.defect(Convention)
        self.sign = panel.phase_sign * (convention.phase_sign if convention else 1)
        self._curve = bench.defect(PhaseResponse)
        self._full = 2 * np.pi
        if self._curve:
            self._full *= (
                self._curve.gain * (self._curve.reference_nm / wavelength_nm) ** self._curve.dispersion
            )
        gain, self._offset = driver_errors(bench.defect(Drivers), panel.height, panel.width)
        self._thickness = _thickness(bench.defect(PhaseNonuniformity), panel.height, panel.width) * gain
        self._thickness = self._thickness * disc_gain(bench.defect(Specks), panel.height, panel.width)
        slow = bench.defect(SlowResponse)
        self._left = slow.share if slow else 0.0
        self._absorption = bench.defect(AmplitudeModulation)
        self.moments = _moments(bench.defect(PhaseRipple))
        self.fields = _fields(bench.defect(PolarisationLeak))
        crosstalk = bench.defect(Crosstalk)
        self._smear_y = self._smear_x = None
        if crosstalk:
            self._smear_y = smear_weights(crosstalk.width_y_px, crosstalk.asymmetry_y, self.q)
            self._smear_x = smear_weights(crosstalk.width_x_px, crosstalk.asymmetry_x, self.q)

    @property
    def smears(self) -> bool:
        """Whether sub-pixels of one pixel differ in phase."""
        return self._smear_x is not None

    @property
    def slow(self) -> bool:
        """Whether the phase depends on what was shown before."""
        return self._left > 0

    @property
    def absorbs(self) -> bool:
        """Whether the amplitude depends on the gray level."""
        return self._absorption is not None

    def turned(self, gray: NDArray[np.floating], before: Array | None = None, times: int = 1) -> Array:
        """How far the pixels' cells have turned, as a share of one wave before gain and thickness, [H, W].

        Parameters
        ----------
        gray : array [H, W]
            Fractions allowed.
        before : float64 array [H, W], optional
            What this returned for the capture before; None: the gray levels have been shown for long.
        times : int
            For how many captures they are shown.
        """
        settled = self._shape(self._has(gray))
        if before is None or not self.slow:
            return settled
        left = self._left**times
        return (1 - left) * settled + left * before

    def magnitude(self, gray: NDArray[np.floating], before: Array | None = None) -> Single:
        """Phase of each pixel before its sign, rad; arguments as of `turned`."""
        phase = self._full * self._thickness * self.turned(gray, before)
        return (phase if self._offset is None else phase + self._offset).astype(np.float32)

    def amplitude(self, gray: NDArray[np.floating]) -> Single:
        """Amplitude on sub-pixels, [qH, qW], where the drive absorbs."""
        d = self._absorption
        if d is None:
            return np.ones((1, 1), np.float32)
        t = self._has(gray) / 255
        amplitude = 1 - d.fall * (t + d.curvature * t * (1 - t))
        return np.float32(self.sign) * self.spread(amplitude.astype(np.float32))

    def amplitude_adjoint(self, gradient: Single, gray: NDArray[np.floating]) -> Array:
        """From d f / d amplitude, [qH, qW], to its part of d f / d gray, [H, W]."""
        d = self._absorption
        if d is None:
            return np.zeros(np.shape(gray))
        t = np.asarray(gray, np.float64) / 255
        slope = -d.fall * (1 + d.curvature * (1 - 2 * t)) / 255
        return np.asarray(self.sign * self.spread_adjoint(gradient) * slope, np.float64)

    def _has(self, gray: NDArray[np.floating]) -> Array:
        """Gray levels as a panel of few levels shows them: the nearest of its own, also across the wave's end."""
        asked = np.asarray(gray, np.float64)
        if self._own is None:
            return asked
        return np.asarray(self._own[np.clip(np.rint(asked), 0, 255).astype(np.intp)])

    def slope(self, gray: NDArray[np.floating]) -> Single:
        """d magnitude / d gray, rad a gray level."""
        d = self._curve
        t = np.asarray(gray) / self.levels
        slope = np.ones_like(t)
        if d:
            slope += -d.s_curvature * np.cos(2 * np.pi * t) + np.pi * d.lopsidedness * np.sin(2 * np.pi * t)
            slope += d.kink * np.where(t < d.kink_at, 1 / d.kink_at, -1 / (1 - d.kink_at))
        return (self._full * self._thickness * slope / self.levels).astype(np.float32)

    def gray_of(self, magnitude: Array) -> Array:
        """Fractional gray, 0..255, of each pixel's phase before its sign, rad; inverse of `magnitude`."""
        if self._offset is not None:
            magnitude = magnitude - self._offset
            magnitude = np.where(magnitude < 0, magnitude + 2 * np.pi, magnitude)
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
        kink = d.kink * np.where(t < d.kink_at, t / d.kink_at, (1 - t) / (1 - d.kink_at))
        return t + bend + d.lopsidedness * np.sin(np.pi * t) ** 2 + kink

    def spread(self, phase: Single) -> Single:
        """Phase on sub-pixels, [qH, qW], of phase a pixel, [H, W]; with the panel's sign."""
        phase = np.float32(self.sign) * phase
        if self._smear_y is None or self._smear_x is None:
            return np.repeat(np.repeat(phase, self.q, 1), self.q, 0)
        return _smear(_smear(phase, self._smear_y).T, self._smear_x).T

    def spread_adjoint(self, phase: Single) -> Single:
        """Adjoint of `spread`: [qH, qW] to [H, W]."""
        h, w = phase.shape
        if self._smear_y is None or self._smear_x is None:
            out = phase.reshape(h // self.q, self.q, w // self.q, self.q).sum((1, 3))
        else:
            out = _smear_adjoint(_smear_adjoint(phase.T, self._smear_x).T, self._smear_y)
        return np.float32(self.sign) * out


def driver_errors(d: Drivers | None, height: int, width: int) -> tuple[Array, Array | None]:
    """Gain [H, W] and offset [H, W], rad, of the phase; without the defect 1 as [1, 1], and None."""
    if d is None:
        return np.ones((1, 1)), None
    rng = np.random.default_rng([d.seed, 53])

    def repeated(period: int, size: int, rms: float) -> Array:
        # of mean 0 and exactly this rms: a mean would be a piston or the phase response's gain
        values = rng.standard_normal(period)
        values -= values.mean()
        return np.resize(rms * values / np.sqrt(np.mean(values**2)), size)

    columns = [repeated(d.column_period, width, rms) for rms in (d.column_offset_rad, d.column_gain)]
    rows = [repeated(d.row_period, height, rms) for rms in (d.row_offset_rad, d.row_gain)]
    offset, gain = (r[:, None] + c[None, :] for r, c in zip(rows, columns, strict=True))
    return 1 + gain, offset


def _moments(d: PhaseRipple | None) -> tuple[Moment, ...]:
    if d is None:
        return (Moment(),)
    return tuple(Moment(1 + d.depth * u, d.offset_rad * u, 0.2) for u in (-1, -0.5, 0, 0.5, 1))


def _fields(d: PolarisationLeak | None) -> tuple[tuple[Component, ...], ...]:
    if d is None:
        return ((Component(),),)
    leak = Component(d.gain, complex(d.amplitude * np.exp(1j * np.deg2rad(d.phase_deg))))
    return ((Component(), leak),) if d.interferes else ((Component(),), (leak,))


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
