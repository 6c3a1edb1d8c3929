"""Free-space propagation of a panel drawn on sub-pixels: one band of spatial frequencies, generously padded.

Lengths are in panel pixels and frequencies in cycles a pixel unless a name says otherwise. Pixel (i, j) has
its centre at (i, j); sub-pixel k of q lies at i + (k + 1/2) / q - 1/2. Only the iris's band is computed.
The transfer is the exact angular spectrum (Goodman, Introduction to Fourier Optics, 3.10), without piston.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex64]
Real = NDArray[np.float32]


def smooth_size(least: int) -> int:
    """The smallest even number of at least `least` whose only prime factors are 2, 3 and 5."""
    n = max(2, least + least % 2)
    while True:
        m = n
        for p in (2, 3, 5):
            while m % p == 0:
                m //= p
        if m == 1:
            return n
        n += 2


def _fft(rows: Complex, n: int | None = None) -> Complex:
    """sum a exp(-2 pi j ...) along each row, with zeros up to n, in single precision."""
    return np.fft.fft(rows, n=n).astype(np.complex64, copy=False)


def _sum(rows: Complex, bins: NDArray[np.integer], n: int) -> Complex:
    """sum a exp(+2 pi j ...) without a factor along each row, of values at some of n frequencies."""
    work = np.zeros((len(rows), n), np.complex64)
    work[:, bins] = rows
    return np.fft.ifft(work, norm="forward").astype(np.complex64, copy=False)


def _in_blocks(transform: Callable[[Complex], Complex], rows: Complex, width: int) -> Complex:
    """The transform of each row, `width` long: some rows at a time, and of a large array on all cores.

    So what it needs on the way stays small, which spares most of the time that fresh memory takes.
    """
    out = np.empty((len(rows), width), np.complex64)
    step = max(1, 2**19 // rows.shape[1])

    def fill(k: int) -> None:
        out[k : k + step] = transform(np.ascontiguousarray(rows[k : k + step]))

    if len(rows) <= step:
        fill(0)
    else:
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            list(pool.map(fill, range(0, len(rows), step)))
    return out


class Band:
    """From sub-pixels to a band of frequencies, from the band to irradiance samples, and both adjoints.

    Parameters
    ----------
    shape : (int, int)
        (H, W), panel pixels.
    q : int
        Sub-pixels across a pixel.
    border_px : float, pixels
        Least number of empty pixels added to each axis.
    half_band : float
        The band's half width, cycles a pixel (0.5 is the panel's own); frequencies that its edges cut are included.
    """

    def __init__(self, shape: tuple[int, int], q: int, border_px: float, half_band: float) -> None:
        self.shape, self.q = shape, q
        self.padded = tuple(smooth_size(int(np.ceil(n + border_px))) for n in shape)
        self.reach = tuple(min(int(np.floor(half_band * n + 0.5)), q * n // 2) for n in self.padded)
        # irradiance has twice the field's bandwidth: two samples a pixel hold the panel's own band
        widest = max(k / n for k, n in zip(self.reach, self.padded, strict=True))
        self.oversampling = max(2, int(np.ceil(4 * widest * (1 - 1e-9))))
        self.fy, self.fx = (np.arange(-k, k + 1) / n for k, n in zip(self.reach, self.padded, strict=True))
        self._env_y, self._env_x = (self._envelope(f) for f in (self.fy, self.fx))
        bins = [np.arange(-k, k + 1) for k in self.reach]
        self._in_y, self._in_x = (b % (q * n) for b, n in zip(bins, self.padded, strict=True))
        self._out_y, self._out_x = (
            b % (self.oversampling * n) for b, n in zip(bins, self.padded, strict=True)
        )

    def _envelope(self, f: NDArray[np.float64]) -> Complex:
        """Sub-pixels are squares of 1/q with their centres off the grid's origin."""
        shift = 0.5 / self.q - 0.5
        return (np.sinc(f / self.q) * np.exp(-2j * np.pi * f * shift) / self.q).astype(np.complex64)

    @property
    def samples(self) -> tuple[int, int]:
        """Shape of the irradiance samples: the padded window, `oversampling` a pixel."""
        return self.oversampling * self.padded[0], self.oversampling * self.padded[1]

    def spectrum(self, field: Complex) -> Complex:
        """Spectrum in the band, [Fy, Fx], of a field on sub-pixels, [qH, qW]."""
        ny, nx = (self.q * n for n in self.padded)
        rows = _in_blocks(lambda block: _fft(block, nx)[:, self._in_x] * self._env_x, field, len(self.fx))
        columns = _in_blocks(lambda block: _fft(block, ny)[:, self._in_y] * self._env_y, rows.T, len(self.fy))
        return columns.T

    def spectrum_adjoint(self, spectrum: Complex) -> Complex:
        """Adjoint of `spectrum`: [Fy, Fx] to [qH, qW]."""
        ny, nx = (self.q * n for n in self.padded)
        height, width = (self.q * n for n in self.shape)
        env_y, env_x = self._env_y.conj(), self._env_x.conj()
        columns = _in_blocks(
            lambda block: _sum(block * env_y, self._in_y, ny)[:, :height], spectrum.T, height
        )
        return _in_blocks(lambda block: _sum(block * env_x, self._in_x, nx)[:, :width], columns.T, width)

    def field(self, spectrum: Complex) -> Complex:
        """Field samples [sY, sX] of a spectrum in the band; sample s i lies on pixel i's centre."""
        ny, nx = self.samples
        scale = np.float32(1 / (self.padded[0] * self.padded[1]))
        columns = _in_blocks(lambda block: _sum(block * scale, self._out_y, ny), spectrum.T, ny)
        return _in_blocks(lambda block: _sum(block, self._out_x, nx), columns.T, nx)

    def field_adjoint(self, field: Complex) -> Complex:
        """Adjoint of `field`: [sY, sX] to [Fy, Fx]."""
        rows = _in_blocks(lambda block: _fft(block)[:, self._out_x], field, len(self.fx))
        columns = _in_blocks(lambda block: _fft(block)[:, self._out_y], rows.T, len(self.fy))
        scale = np.float32(1 / (self.padded[0] * self.padded[1]))
        return columns.T * scale

    def transfer(self, wavelength_nm: float, pitch_um: float, distance_mm: float) -> NDArray[np.complex128]:
        """Exact angular spectrum over the band, [Fy, Fx], of a distance (negative: backwards)."""
        pitch = pitch_um * 1e-6
        k = 1 / (wavelength_nm * 1e-9)
        f2 = (self.fy[:, None] / pitch) ** 2 + (self.fx[None, :] / pitch) ** 2
        travelling = np.clip(k**2 - f2, 0, None)
        # sqrt(k^2 - f^2) - k, written so that nothing cancels
        path = -np.where(f2 < k**2, f2, k**2) / (np.sqrt(travelling) + k)
        return np.where(f2 < k**2, np.exp(2j * np.pi * distance_mm * 1e-3 * path), 0)


def walk_px(wavelength_nm: float, pitch_um: float, distance_mm: float, half_band: float) -> float:
    """Sideways distance that light at the band's edge travels.

    Parameters
    ----------
    wavelength_nm : float, nm
    pitch_um : float, µm
    distance_mm : float, mm
    half_band : float, cycles a pixel

    Returns
    -------
    float, panel pixels
    """
    sine = min(half_band * wavelength_nm * 1e-3 / pitch_um, 0.99)
    return abs(distance_mm) * 1e3 / pitch_um * sine / np.sqrt(1 - sine**2)
