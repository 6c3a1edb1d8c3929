"""A camera that reads irradiance again and again, in buffers of its own: forward, adjoint, and slopes over its view.

What it reads is what `runtime.camera.view.sampler` reads, in single precision. That one gives new arrays for any number
of pictures; this one is for fits, which read one picture after another of a size at which new arrays cost more than the
arithmetic on them.
"""

from __future__ import annotations

import numpy as np

from runtime.camera.sampling import pixel_area, sample_places, spline_filter, spline_matrices
from runtime.camera.view import View
from runtime.lightpath import fft
from runtime.lightpath.grid import Grid, image_frequencies


class Reading:
    """The linear map from irradiance on a fine grid to camera pixels.

    Parameters
    ----------
    view : View
    grid : Grid
        Of the light path.
    own_filter : complex array [n, m // 2 + 1] or None
        The light path's filter of irradiance, which is applied on the way.
    finer : int
        As of `sampler`.
    slopes : bool
        Whether `motion` is wanted.
    threads : int
    """

    def __init__(
        self,
        view: View,
        grid: Grid,
        own_filter: np.ndarray | None = None,
        finer: int = 2,
        slopes: bool = False,
        threads: int = fft.THREADS,
    ) -> None:
        self.view, self.grid, self.finer, self.threads = view, grid, finer, threads
        y, x = view.positions(grid.shape)
        fy, fx = image_frequencies(grid, np.zeros((), np.float64))
        self.fy, self.fx = fy[:, None] * grid.pitch, fx[None, :] * grid.pitch  # cycles a panel pixel
        transfer = pixel_area(self.fy, self.fx, y, x) / spline_filter(self.fy, self.fx, grid.fine * finer)
        for variance, f in ((view.blur_y_px2, self.fy), (view.blur_x_px2, self.fx)):
            transfer = transfer * np.exp(-2 * np.pi**2 * variance * f**2)
        if own_filter is not None:
            transfer = transfer * own_filter
        height, width = grid.image_shape
        # the highest frequency of an even axis has no sign of its own, as in `finer_picture`
        transfer[height // 2 : height // 2 + 1 - height % 2] = 0
        transfer[:, (width + 1) // 2 :] = 0
        transfer /= height * width
        self.transfer = transfer.astype(np.float32 if own_filter is None else np.complex64)
        half = (height + 1) // 2
        more = (finer - 1) * height
        self.halves = ((slice(0, half), slice(0, half)), (slice(half, height), slice(half + more, None)))
        self.gap = slice(half, half + more)
        y, x = sample_places(grid, y, x, finer)
        self.matrices = spline_matrices(y, x, (finer * height, finer * width), slopes)
        self.spectrum = np.zeros((height, width // 2 + 1), np.complex64)
        self.wide = np.zeros((finer * height, finer * width // 2 + 1), np.complex64)
        self.fine = np.zeros((finer * height, finer * width), np.float32)
        self.back = np.zeros((height, width), np.float32)

    def read(self, image: np.ndarray) -> np.ndarray:
        """What the camera's pixels read.

        Parameters
        ----------
        image : float32 array [*grid.image_shape]

        Returns
        -------
        float32 array [h, w]
        """
        fft.real_into(image, self.spectrum, self.threads)
        self.spectrum *= self.transfer
        return self._seen(1.0)

    def _seen(self, factor: np.ndarray | float) -> np.ndarray:
        """What the camera's pixels read of the spectrum times a factor."""
        columns = self.spectrum.shape[1]
        for here, there in self.halves:
            part = factor[here] if isinstance(factor, np.ndarray) and len(factor) > 1 else factor
            np.multiply(self.spectrum[here], part, out=self.wide[there, :columns])
        self.wide[self.gap] = 0
        self.wide[:, columns:] = 0
        fft.real_from(self.wide, self.fine, self.threads)
        return np.asarray(self.matrices[0] @ self.fine.reshape(-1)).reshape(self.view.shape)

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """`motion` from the spectrum: right for waves of any frequency, at the price of two more transforms."""
        down, right = (self._seen((2j * np.pi * f).astype(np.complex64)) for f in (self.fy, self.fx))
        return down, right

    def blurred(self) -> tuple[np.ndarray, np.ndarray]:
        """How what was last read changes with the variances of the lens's blur along y and x: two [h, w]."""
        down, right = (self._seen((-2 * np.pi**2 * f**2).astype(np.float32)) for f in (self.fy, self.fx))
        return down, right

    def motion(self) -> tuple[np.ndarray, np.ndarray]:
        """How what was last read changes where each pixel looks a panel pixel farther down, and right: two [h, w]."""
        scale = np.float32(self.grid.fine * self.finer)
        down, right = (
            scale * (one @ self.fine.reshape(-1)).reshape(self.view.shape) for one in self.matrices[1:]
        )
        return down, right

    def adjoint(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From a loss's gradient over what was last read to the one over irradiance.

        Parameters
        ----------
        light : float32 array [h, w]

        Returns
        -------
        float32 array [*grid.image_shape]
            Valid until the next call.
        float array [2], 1 / panel pixel squared
            The gradient over the variances of the lens's blur, along y and x.
        """
        flat = np.asarray(light, np.float32).reshape(-1)
        fft.real_into((self.matrices[0].T @ flat).reshape(self.fine.shape), self.wide, self.threads)
        columns, came = self.spectrum.shape[1], self.spectrum
        along_y, along_x = np.zeros(len(came)), np.zeros(columns)
        for here, there in self.halves:
            part = self.wide[there, :columns]
            product = came[here].real * part.real
            product += came[here].imag * part.imag
            along_y[here] = 2 * product[:, 1:].sum(1) + product[:, 0]
            along_x += product.sum(0)
            np.multiply(part, np.conj(self.transfer[here]), out=came[here])
        along_x[1:] *= 2
        fft.real_from(came, self.back, self.threads)
        blur = -2 * np.pi**2 * np.array([along_y @ self.fy[:, 0] ** 2, along_x @ self.fx[0] ** 2])
        return self.back, blur
