"""From irradiance samples to camera counts: the picture for the eye, the camera's picture, its noise.

Irradiance samples [sY, sX] lie s a panel pixel over a padded window, sample (s i, s j) on the centre of pixel
(i, j). Pixels integrate over their area: the box, the ghost and the lens are one exact filter of frequency.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.camera_motion import CameraMotion
from firmware_iface.virtual.defects import (
    Convention,
    Fringes,
    Ghost,
    LaserDrift,
    Misregistration,
    SensorBlur,
    SensorResponse,
    StrayLight,
    Vignetting,
)
from firmware_iface.virtual.further_defects import FixedPattern
from firmware_iface.virtual.simulated_panel import share_grid

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Complex = NDArray[np.complex64]


class Integrator:
    """Irradiance on camera pixels, and on panel pixels, as the eye would see it.

    Parameters
    ----------
    bench : BenchDescription
    samples : (int, int)
        (sY, sX), shape of the irradiance samples.
    oversampling : int
        s, samples a panel pixel.
    """

    def __init__(self, bench: BenchDescription, samples: tuple[int, int], oversampling: int) -> None:
        self.bench, self.samples, self.s = bench, samples, oversampling
        fy: Array = np.asarray(np.fft.fftfreq(samples[0]) * oversampling, np.float64)[:, None]
        fx: Array = np.asarray(np.fft.rfftfreq(samples[1]) * oversampling, np.float64)[None, :]
        self._fy, self._fx = fy, fx
        ghost = ghost_filter(bench.defect(Ghost), fy, fx)
        lens = lens_filter(bench.defect(SensorBlur), fy, fx)
        side = bench.camera.pixel_um / bench.panel.pitch_um
        self._display = (np.sinc(fy) * np.sinc(fx) * ghost).astype(np.complex64)
        self._camera = (np.sinc(fy * side) * np.sinc(fx * side) * ghost * lens).astype(np.complex64)
        self._where = camera_positions(bench)

    def display(self, irradiance: Single) -> Single:
        """Irradiance on panel pixels, [H, W], before any fault of the camera."""
        return self._on_grid(np.fft.rfft2(irradiance) * self._display)

    def display_adjoint(self, gradient: NDArray[np.floating]) -> Single:
        """Adjoint of `display`: [H, W] to [sY, sX]."""
        h, w = self.bench.panel.height, self.bench.panel.width
        wide = np.zeros(self.samples, np.float32)
        wide[: self.s * h : self.s, : self.s * w : self.s] = gradient
        return np.fft.irfft2(np.fft.rfft2(wide) * self._display.conj(), s=self.samples).astype(np.float32)

    def camera(self, irradiance: Single, motion: CameraMotion | None = None) -> Array:
        """Irradiance on camera pixels, [h, w]: through the lens, at the camera's true position."""
        spectrum = np.fft.rfft2(irradiance) * self._camera
        if motion is not None:
            spectrum = spectrum * motion.filter(self._fy, self._fx)
        if self._where is None:
            return self._on_grid(spectrum).astype(np.float64)
        up = max(1, round(4 / self.s))
        ny, nx = self.samples
        wide = np.zeros((up * ny, up * nx // 2 + 1), np.complex64)
        half = ny // 2
        wide[:half, : spectrum.shape[1]] = spectrum[:half]
        wide[-half:, : spectrum.shape[1]] = spectrum[-half:]
        fine = np.fft.irfft2(wide, s=(up * ny, up * nx)) * np.float32(up * up)
        y, x = self._where
        return interpolate(fine, y * self.s * up, x * self.s * up)

    def _on_grid(self, spectrum: NDArray[np.complexfloating]) -> Single:
        h, w = self.bench.panel.height, self.bench.panel.width
        fine = np.fft.irfft2(spectrum, s=self.samples)
        return fine[: self.s * h : self.s, : self.s * w : self.s].astype(np.float32)


def ghost_filter(d: Ghost | None, fy: Array, fx: Array) -> Complex | Array:
    """Effect of a weak displaced copy on the irradiance's spectrum; f in cycles a pixel."""
    if d is None:
        return np.ones((1, 1))
    blur = np.exp(-2 * (np.pi * d.sigma_px) ** 2 * (fy**2 + fx**2))
    return np.asarray(
        1 + d.share * blur * np.exp(-2j * np.pi * (fy * d.shift_y_px + fx * d.shift_x_px)), np.complex64
    )


def lens_filter(d: SensorBlur | None, fy: Array, fx: Array) -> Array:
    """Transfer of the camera's lens; f in cycles a pixel."""
    if d is None:
        return np.ones((1, 1))
    core = np.exp(-2 * np.pi**2 * ((d.sigma_y_px * fy) ** 2 + (d.sigma_x_px * fx) ** 2))
    halo = np.exp(-2 * (np.pi * d.halo_sigma_px) ** 2 * (fy**2 + fx**2))
    return (1 - d.halo_share) * core + d.halo_share * halo


def camera_positions(bench: BenchDescription) -> tuple[Array, Array] | None:
    """(y, x), each [h, w]: panel coordinates of the camera pixels; None where they are the panel's own."""
    d = bench.defect(Misregistration)
    camera = bench.camera
    if camera.registered and d is None:
        return None
    y, x = np.meshgrid(
        np.arange(camera.height, dtype=float), np.arange(camera.width, dtype=float), indexing="ij"
    )
    if not camera.registered:
        m = np.array(camera.homography).reshape(3, 3)
        x, y, scale = (m[i, 0] * x + m[i, 1] * y + m[i, 2] for i in range(3))
        y, x = y / scale, x / scale
    if d is None:
        return y, x
    cy, cx = (bench.panel.height - 1) / 2, (bench.panel.width - 1) / 2
    v, u = y - cy, x - cx
    corner = np.hypot(cy, cx)
    stretch = d.scale + d.distortion_px / corner * ((v**2 + u**2) / corner**2)
    cos, sin = np.cos(d.rotation_mrad * 1e-3), np.sin(d.rotation_mrad * 1e-3)
    return (
        cy + d.shift_y_px + stretch * (cos * v + sin * u),
        cx + d.shift_x_px + stretch * (cos * u - sin * v),
    )


def interpolate(image: NDArray[np.floating], y: Array, x: Array) -> Array:
    """Values of a periodic image between its samples, by 6-point Lagrange polynomials along each axis."""
    (iy, wy), (ix, wx) = _lagrange(y), _lagrange(x)
    out = np.zeros(y.shape)
    for a in range(6):
        row = (iy + a) % image.shape[0]
        line = np.zeros(y.shape)
        for b in range(6):
            line += wx[b] * image[row, (ix + b) % image.shape[1]]
        out += wy[a] * line
    return out


def _lagrange(t: Array) -> tuple[NDArray[np.int64], list[Array]]:
    start = np.floor(t).astype(np.int64) - 2
    u = t - start
    weights = []
    for a in range(6):
        weight = np.ones_like(u)
        for b in range(6):
            if b != a:
                weight *= (u - b) / (a - b)
        weights.append(weight)
    return start, weights


class Sensor:
    """The camera after its lens: sensitivity, added light, response, and the chip's noise."""

    def __init__(self, bench: BenchDescription) -> None:
        self.bench = bench
        h, w = bench.camera.height, bench.camera.width
        self.gain = sensitivity(bench.defect(Vignetting), h, w) * fringes(bench.defect(Fringes), h, w)
        full_counts = 2**bench.camera.bit_depth - 1 - bench.camera.black_level
        self.stray_e = stray_counts(bench.defect(StrayLight), h, w) / full_counts * bench.camera.full_well_e
        self.pixel_gain, self.pixel_counts = fixed_pattern(bench.defect(FixedPattern), h, w)
        self._response = bench.defect(SensorResponse)
        self._convention = bench.defect(Convention)

    def electrons(self, irradiance: Array, dose: float) -> Array:
        """Mean electrons of irradiance on camera pixels.

        Parameters
        ----------
        irradiance : float64 array [h, w]
        dose : float
            Power as a share of full power, times exposure over 10 ms.

        Returns
        -------
        float64 array [h, w]
        """
        d = self._convention
        if d and d.mirror_x:
            irradiance = irradiance[:, ::-1]
        if d and d.flip_y:
            irradiance = irradiance[::-1]
        camera = self.bench.camera
        signal = (
            np.clip(irradiance, 0, None) * self.gain * self.bench.simulation.signal_share * camera.full_well_e
        )
        return dose * (signal + self.stray_e) * self.pixel_gain

    def respond(self, electrons: Array) -> Array:
        """Electrons as the read-out reports them, after a response that may be nonlinear."""
        d = self._response
        if d is None:
            return electrons
        share = np.clip(electrons, 0, None) / self.bench.camera.full_well_e
        return electrons / (1 + (share / d.knee_share) ** d.sharpness) ** (1 / d.sharpness)

    def counts(self, electrons: Array) -> Array:
        """Counts of reported electrons, neither rounded nor clipped."""
        camera = self.bench.camera
        full = 2**camera.bit_depth - 1
        counts = camera.black_level + (full - camera.black_level) * electrons / camera.full_well_e
        return counts + self.pixel_counts

    def expose(self, electrons: Array, rng: np.random.Generator) -> NDArray[np.uint16]:
        """One noisy read-out, [h, w], of mean electrons (response applied), rounded and clipped."""
        camera = self.bench.camera
        collected = rng.poisson(np.clip(electrons, 0, 1e9)) + rng.normal(
            0, camera.read_noise_e, electrons.shape
        )
        counts = np.clip(np.rint(self.counts(collected)), 0, 2**camera.bit_depth - 1).astype(np.uint16)
        if self._convention and self._convention.left_justified:
            counts <<= 16 - camera.bit_depth
        return counts


def sensitivity(d: Vignetting | None, height: int, width: int) -> Array:
    """cos^4 of the field angle about an off-centre axis, 1 at its best, [height, width]."""
    if d is None:
        return np.ones((1, 1))
    y, x = share_grid(height, width)
    diagonal = np.hypot(height, width)
    r = np.hypot((y - d.centre_y_share) * height, (x - d.centre_x_share) * width) / diagonal
    return 1 / (1 + (r * np.tan(np.deg2rad(d.corner_angle_deg))) ** 2) ** 2


def fringes(d: Fringes | None, height: int, width: int) -> Array:
    """1 + a chirped sinusoid, [height, width]."""
    if d is None:
        return np.ones((1, 1))
    y, x = share_grid(height, width)
    turn = np.deg2rad(d.angle_deg)
    t = x * width / 2 * np.cos(turn) + y * height / 2 * np.sin(turn)
    half = np.hypot(height, width) / 2
    contrast = d.contrast * (1 + d.fade * x)
    return 1 + contrast * np.cos(2 * np.pi / d.period_px * (t + d.chirp * t**2 / (2 * half)) + 0.5)


def stray_counts(d: StrayLight | None, height: int, width: int) -> Array:
    """Added light at full power and 10 ms, counts, [height, width]."""
    if d is None:
        return np.zeros((1, 1))
    y, x = share_grid(height, width)
    first = np.exp(-((x - 0.5) ** 2 + (y + 0.35) ** 2) / d.radius_share**2)
    second = np.exp(-((x + 0.7) ** 2 + 0.4 * (y - 0.6) ** 2) / (0.6 * d.radius_share) ** 2)
    return d.glow_counts * first + d.second_glow_counts * second


def fixed_pattern(d: FixedPattern | None, height: int, width: int) -> tuple[Array, Array]:
    """Gain and offset, counts, of each camera pixel, [height, width]."""
    if d is None:
        return np.ones((1, 1)), np.zeros((1, 1))
    gain, offset = np.random.default_rng([d.seed, 73]).standard_normal((2, height, width))
    return np.clip(1 + d.gain_rms * gain, 0, None), d.offset_counts * offset


class Drift:
    """The lasers' power, capture by capture; the same for the same seed."""

    def __init__(self, d: LaserDrift | None, seed: int) -> None:
        self._d, self._rng = d, np.random.default_rng([seed, 41])
        self._walk = [0.0]

    def gain(self, index: int) -> float:
        """Power of capture `index` over the mean."""
        d = self._d
        if d is None:
            return 1.0
        while len(self._walk) <= index:
            # a servo pulls the walk back slowly
            self._walk.append(0.97 * self._walk[-1] + d.walk_share * float(self._rng.standard_normal()))
        return max(
            0.05, 1 + self._walk[index] + d.sine_share * np.sin(2 * np.pi * index / d.period_captures + 0.8)
        )
