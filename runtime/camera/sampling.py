"""What camera pixels integrate of irradiance on a fine grid: pixel area, band extension and cubic splines.

One camera for the trainer and the headset, against the array API. A picture of irradiance is filtered by the pixel's
area, put on a finer grid by zero-padding its spectrum, and read where each pixel looks by cubic B-splines that pass
through the samples. Places are (y, x), in panel pixels or in samples of the fine grid, as said.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from array_api_compat import array_namespace
from scipy import ndimage
from scipy.sparse import csr_matrix

from runtime.camera.registration import panel_points
from runtime.lightpath.fft import ifft, irfft, irfft2
from runtime.lightpath.grid import Grid

Array = Any
PLACES = 1 << 16  # whose splines are worked out at a time: what is between stays in a core's cache


def pixel_area(iy: Array, ix: Array, y: Array, x: Array) -> Array:
    """Transfer function of the camera pixel's area, a parallelogram.

    Parameters
    ----------
    iy, ix : arrays [n, 1] and [1, m], cycles a panel pixel
        Frequencies of the irradiance.
    y, x : arrays [h, w], panel pixels
        Where each camera pixel's centre looks. The pixel's sides are taken at the picture's centre.

    Returns
    -------
    real array [n, m]
    """
    xp = array_namespace(iy)
    i, j = y.shape[0] // 2, y.shape[1] // 2
    down = (y[i, j] - y[i - 1, j], x[i, j] - x[i - 1, j])
    right = (y[i, j] - y[i, j - 1], x[i, j] - x[i, j - 1])
    return xp.sinc(iy * down[0] + ix * down[1]) * xp.sinc(iy * right[0] + ix * right[1])


def registered_samples(grid: Grid, spectrum: Array) -> Array:
    """The picture of a spectrum at the centres of the panel's pixels.

    To read every second sample of a picture is to fold its spectrum: the inverse transform is a quarter as large, and
    where pixels have four samples an axis, a sixteenth.

    Parameters
    ----------
    grid : Grid
    spectrum : complex array [..., n, m // 2 + 1]
        As from `rfft2` of a picture on the fine image grid.

    Returns
    -------
    real array [..., H, W]
    """
    (rows, columns), samples = grid.image_shape, grid.fine
    while samples > 1:
        rows, columns, samples = rows // 2, columns // 2, samples // 2
        spectrum = _folded(spectrum, rows, columns)
    picture, margin = irfft2(spectrum, (rows, columns)), grid.margin
    return picture[..., margin : margin + grid.shape[0], margin : margin + grid.shape[1]]


def _folded(spectrum: Array, rows: int, columns: int) -> Array:
    """Half spectrum of every second sample of a picture, which has that many rows and columns of them."""
    xp = array_namespace(spectrum)
    folded = spectrum[..., :rows, :] + spectrum[..., rows:, :]
    last = columns // 2 + 1
    # The columns beyond the half spectrum are those of the negative frequencies: reversed, conjugated.
    mirrored = xp.flip(folded[..., columns - last + 1 :], axis=-1)
    mirrored = xp.conj(xp.roll(xp.flip(mirrored, axis=-2), 1, axis=-2))
    return (folded[..., :last] + mirrored) / 4


def spline_filter(iy: Array, ix: Array, samples: int) -> Array:
    """Transfer function to divide by, so that `spline_samples` passes through the samples.

    Parameters
    ----------
    iy, ix : arrays [n, 1] and [1, m], cycles a panel pixel
    samples : int
        Of the splines, a panel pixel, an axis.

    Returns
    -------
    real array [n, m]
    """
    xp = array_namespace(iy)
    rows, columns = ((2 + xp.cos(2 * math.pi * f / samples)) / 3 for f in (iy, ix))
    return rows * columns


def finer_picture(spectrum: Array, shape: tuple[int, int], finer: int) -> Array:
    """The picture of a spectrum on a grid that is finer.

    Parameters
    ----------
    spectrum : complex array [..., n, m // 2 + 1]
        As from `rfft2` of a picture of `shape`. The highest frequency of an even axis has no sign of its own and is
        left out.
    shape : (int, int)
        (n, m), samples of the picture.
    finer : int
        How many times as fine the result is.

    Returns
    -------
    real array [..., finer n, finer m]
    """
    xp = array_namespace(spectrum)
    (height, width), half = shape, (shape[0] + 1) // 2
    # A finer grid adds rows and columns that are zero; so is the highest frequency of an even axis.
    known = finer**2 * spectrum[..., : (width + 1) // 2]
    below = known[..., height // 2 + 1 :, :]
    added = (*known.shape[:-2], finer * height - half - below.shape[-2], known.shape[-1])
    zeros = xp.zeros(added, dtype=known.dtype, device=known.device)
    rows = xp.concat([known[..., :half, :], zeros, below], axis=-2)
    return irfft(ifft(rows, axis=-2), finer * width)


def finer_picture_adjoint(spectrum: Array, shape: tuple[int, int]) -> Array:
    """Adjoint of `finer_picture`: `irfft2` of the result is the adjoint's picture.

    Parameters
    ----------
    spectrum : complex array [..., finer n, finer m // 2 + 1]
        As from `rfft2` of a finer picture.
    shape : (int, int)
        (n, m), samples of the coarser picture.

    Returns
    -------
    complex array [..., n, m // 2 + 1]
    """
    xp = array_namespace(spectrum)
    half, columns = (shape[0] + 1) // 2, shape[1] // 2 + 1
    kept = xp.concat([spectrum[..., :half, :columns], spectrum[..., half - shape[0] :, :columns]], axis=-2)
    return kept * _below_highest(shape, kept)


def _below_highest(shape: tuple[int, int], like: Array) -> Array:
    """0 at an even axis's highest frequency, else 1: [n, m // 2 + 1], for a spectrum as from `rfft2`."""
    xp = array_namespace(like)
    kept = np.ones((shape[0], shape[1] // 2 + 1))
    if shape[0] % 2 == 0:
        kept[shape[0] // 2] = 0
    if shape[1] % 2 == 0:
        kept[:, -1] = 0
    return xp.asarray(kept, dtype=xp.real(like).dtype, device=like.device)


def sample_places(grid: Grid, y: Array, x: Array, finer: int) -> tuple[Array, Array]:
    """Places in panel pixels as places in samples of a picture.

    Parameters
    ----------
    grid : Grid
    y, x : arrays [h, w], panel pixels
    finer : int
        How many times as fine as the light path's fine grid the picture is.

    Returns
    -------
    (y, x), arrays [h, w], samples
    """
    samples = grid.fine * finer
    return samples * (y + grid.margin), samples * (x + grid.margin)


def spline_samples(coefficients: Array, y: Array, x: Array) -> Array:
    """Cubic B-spline sum at places; 0 where a place has not two samples on each side.

    Parameters
    ----------
    coefficients : real array [..., n, m]
    y, x : arrays [h, w], samples
        They may carry gradients.

    Returns
    -------
    real array [..., h, w]
    """
    height, width = coefficients.shape[-2:]
    leading, places = tuple(coefficients.shape[:-2]), tuple(y.shape)
    flat = coefficients.reshape(-1, height * width)
    rows, row_weights = _taps(y.reshape(-1), height)
    columns, column_weights = _taps(x.reshape(-1), width)
    total: Array = 0
    for i in range(4):
        inner: Array = 0
        for j in range(4):
            inner = inner + flat[:, rows[i] * width + columns[j]] * column_weights[j]
        total = total + inner * row_weights[i]
    return total.reshape(*leading, *places)


def spline_matrix(y: np.ndarray, x: np.ndarray, shape: tuple[int, int]) -> csr_matrix:
    """`spline_samples` at fixed places, as a matrix.

    Parameters
    ----------
    y, x : float arrays [h, w], samples
    shape : (int, int)
        (n, m), samples of the picture.

    Returns
    -------
    sparse float32 matrix [h w, n m]
    """
    return spline_matrices(y, x, shape, slopes=False)[0]


def spline_matrices(
    y: np.ndarray, x: np.ndarray, shape: tuple[int, int], slopes: bool = True
) -> list[csr_matrix]:
    """`spline_samples` at fixed places, and with `slopes` its derivatives over y and over x, a sample, as matrices.

    Parameters
    ----------
    y, x : float arrays [h, w], samples
    shape : (int, int)
        (n, m), samples of the picture.
    slopes : bool

    Returns
    -------
    list of sparse float32 matrix [h w, n m]
        They share their indices: a matrix has 16 values for each place, so at full size each copy counts.
    """
    kind = np.int32 if shape[0] * shape[1] < 2**31 else np.int64
    y, x, count = y.ravel(), x.ravel(), y.size
    products = ((1, 1), (2, 1), (1, 2)) if slopes else ((1, 1),)
    places = np.empty((count, 4, 4), kind)
    values = [np.empty((count, 4, 4), np.float32) for _ in products]
    across: np.ndarray = np.arange(4, dtype=kind)
    down = across[:, None] * shape[1]

    for begin in range(0, count, PLACES):
        some = slice(begin, begin + PLACES)
        of_y, of_x = _taps_and_slopes(y[some], shape[0]), _taps_and_slopes(x[some], shape[1])
        first: np.ndarray = of_y[0].astype(kind) * shape[1] + of_x[0]
        np.add(first[:, None, None], down + across, out=places[some])
        for one, (k, n) in zip(values, products, strict=True):
            np.multiply(of_y[k].T[:, :, None], of_x[n].T[:, None, :], out=one[some])
    ends = np.arange(0, 16 * count + 1, 16, dtype=np.int32 if 16 * count < 2**31 else np.int64)
    size = (count, shape[0] * shape[1])
    return [csr_matrix((one.ravel(), places.ravel(), ends), shape=size, copy=False) for one in values]


def _taps_and_slopes(place: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first of four samples for each place, their weights [4, n], and the derivatives of those.

    Where a place has not two samples on each side, the samples are the first four, and both are 0.
    """
    whole = np.floor(place)
    inside = (whole >= 1) & (whole + 2 < count)
    first = np.where(inside, whole, 1).astype(np.int32) - 1
    t = (place - whole).astype(np.float32)
    u = 1 - t
    weights = np.stack([u**3, 3 * t**3 - 6 * t**2 + 4, 3 * u**3 - 6 * u**2 + 4, t**3]) / np.float32(6)
    slopes = np.stack([-(u**2), 3 * t**2 - 4 * t, 4 * u - 3 * u**2, t**2]) / np.float32(2)
    return first, weights * inside, slopes * inside


def _taps(place: Array, count: int) -> tuple[list[Array], list[Array]]:
    """Four samples and their weights for each place along an axis of `count` samples; weight 0 outside."""
    xp = array_namespace(place)
    whole = xp.floor(place)
    t = place - whole
    first = xp.astype(whole, xp.int64) - 1
    inside = xp.astype((first >= 0) & (first + 3 < count), place.dtype)
    weights = (
        (1 - t) ** 3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
        t**3 / 6,
    )
    return [xp.clip(first + k, 0, count - 1) for k in range(4)], [w * inside for w in weights]


def panel_on_camera(homography: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Where on the camera the pixels of a panel of `shape` fall.

    Parameters
    ----------
    homography : float array [3, 3]
        From camera pixels (x, y, 1) to panel pixels.
    shape : (int, int)
        (H, W), pixels of the panel.

    Returns
    -------
    (y, x), float64 arrays [H, W], camera pixels
    """
    y, x = np.indices(shape, dtype=float)
    return camera_places(homography, y, x)


def camera_places(homography: np.ndarray, y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where on the camera places of the panel fall.

    Parameters
    ----------
    homography : float array [3, 3]
        From camera pixels (x, y, 1) to panel pixels.
    y, x : float arrays [H, W], panel pixels

    Returns
    -------
    (y, x), float64 arrays [H, W], camera pixels
    """
    there = panel_points(np.linalg.inv(np.asarray(homography, float)), np.stack([x.ravel(), y.ravel()], 1))
    return there[:, 1].reshape(y.shape), there[:, 0].reshape(y.shape)


def rectified(picture: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A picture resampled at places, by cubic splines through its pixels; 0 outside.

    Parameters
    ----------
    picture : array [h, w]
    y, x : float arrays [H, W], pixels of the picture

    Returns
    -------
    float array [H, W]
        Of the picture's type; float32 for whole numbers.
    """
    kind = picture.dtype if np.issubdtype(picture.dtype, np.floating) else np.float32
    return np.asarray(ndimage.map_coordinates(picture, (y, x), output=kind, order=3)).reshape(y.shape)
