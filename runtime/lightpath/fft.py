"""Fourier transforms along an axis, by the fastest library that fits the array.

NumPy arrays go to ducc0 (SciPy where ducc0 is missing), and so do torch's tensors in the host's memory that need no
derivative: it takes a third to a half of the time of torch's own. Any other array goes to its own namespace's ``fft``.
Forward transforms are not scaled, inverse ones are divided by their length (NumPy's convention).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace

from runtime.lightpath.host_arrays import of_kind, on_host
from runtime.program.threads import cores

try:
    import ducc0.fft as _ducc
except ImportError:  # pragma: no cover - exercised only where the wheel is missing
    _ducc = None
    import scipy.fft as _scipy

Array = Any

THREADS = cores()
STRIP = 32  # rows that a core transforms at a time


def fft(x: Array, axis: int, n: int | None = None) -> Array:
    """DFT of a complex array along `axis`, zero-padded at its end to `n` samples."""
    return _transform(x, axis, n, forward=True)


def ifft(x: Array, axis: int, n: int | None = None) -> Array:
    """Inverse DFT of a complex array along `axis`, zero-padded at its end to `n` samples, divided by n."""
    return _transform(x, axis, n, forward=False)


def rfft2(x: Array) -> Array:
    """DFT of a real array over its last two axes: [..., n, m] to [..., n, m//2 + 1]."""
    host = _on_host(x)
    if host is not None:
        return of_kind(x, _ducc.r2c(host, axes=(-2, -1), nthreads=_threads(x)))
    return array_namespace(x).fft.rfftn(x, axes=(-2, -1))


def irfft2(x: Array, shape: tuple[int, int]) -> Array:
    """Inverse of `rfft2` with `shape` the last two axes of the real result."""
    host = _on_host(x)
    if host is not None:
        size = shape[1]
        back = _ducc.c2r(host, lastsize=size, axes=(-2, -1), forward=False, inorm=2, nthreads=_threads(x))
        return of_kind(x, back)
    return array_namespace(x).fft.irfftn(x, s=shape, axes=(-2, -1))


def irfft(x: Array, n: int) -> Array:
    """Inverse DFT of half a spectrum along the last axis, zero-padded at its end, to `n` real samples, divided by n."""
    host = _on_host(x)
    if host is not None:
        return of_kind(x, _padded_rows(host, n, _threads(x)))
    return array_namespace(x).fft.irfft(x, n=n, axis=-1)


def _padded_rows(half: np.ndarray, n: int, threads: int) -> np.ndarray:
    """`irfft` by strips of rows that stay in a core's cache with their padding."""
    spectra = half.reshape(-1, half.shape[-1])
    rows = np.empty((len(spectra), n), half.real.dtype)
    strip = np.zeros((min(STRIP * threads, len(spectra)), n // 2 + 1), half.dtype)
    for begin in range(0, len(spectra), len(strip)):
        some = spectra[begin : begin + len(strip)]
        strip[: len(some), : some.shape[1]] = some
        _ducc.c2r(
            strip[: len(some)],
            lastsize=n,
            axes=(-1,),
            forward=False,
            inorm=2,
            out=rows[begin : begin + len(some)],
            nthreads=threads,
        )
    return rows.reshape(*half.shape[:-1], n)


def has_ducc() -> bool:
    """Whether ducc0 is installed; SciPy does its work otherwise."""
    return _ducc is not None


def into(x: np.ndarray, out: np.ndarray, axes: int | tuple[int, ...], forward: bool, threads: int) -> None:
    """DFT of complex `x` [n, m] along axes, written to `out` (which may be x); neither direction is scaled."""
    over = (axes,) if isinstance(axes, int) else axes
    if _ducc is not None:
        _ducc.c2c(x, axes=over, forward=forward, out=out, nthreads=threads)
    elif forward:  # pragma: no cover
        out[...] = _scipy.fftn(x, axes=over, overwrite_x=x is out, workers=threads)
    else:  # pragma: no cover
        out[...] = _scipy.ifftn(x, axes=over, norm="forward", overwrite_x=x is out, workers=threads)


def filter_into(image: np.ndarray, transfer: np.ndarray, spectrum: np.ndarray, threads: int) -> None:
    """Multiply a real image by a transfer function over its half spectrum, in place.

    Parameters
    ----------
    image : float array [n, m]
    transfer : complex array [n, m//2 + 1]
    spectrum : complex array [n, m//2 + 1]
        Room to work in.
    threads : int
    """
    real_into(image, spectrum, threads)
    np.multiply(spectrum, transfer, out=spectrum)
    real_from(spectrum, image, threads, scaled=True)


def real_into(image: np.ndarray, spectrum: np.ndarray, threads: int = THREADS) -> None:
    """DFT of real `image` [n, m], not scaled, written to `spectrum` [n, m//2 + 1]."""
    if _ducc is not None:
        _ducc.r2c(image, axes=(0, 1), out=spectrum, nthreads=threads)
    else:  # pragma: no cover
        spectrum[...] = _scipy.rfft2(image, workers=threads)


def real_from(spectrum: np.ndarray, image: np.ndarray, threads: int = THREADS, scaled: bool = False) -> None:
    """Inverse DFT of half a spectrum [n, m//2 + 1], written to real `image` [n, m]; `scaled`: divided by n m."""
    if _ducc is not None:
        size, norm = image.shape[1], 2 if scaled else 0
        _ducc.c2r(
            spectrum, axes=(0, 1), lastsize=size, forward=False, inorm=norm, out=image, nthreads=threads
        )
    else:  # pragma: no cover
        way = "backward" if scaled else "forward"
        image[...] = _scipy.irfft2(spectrum, s=image.shape, norm=way, workers=threads)


def _on_host(x: Array) -> np.ndarray | None:
    """The array for ducc0 to work on; None where another library must."""
    return None if _ducc is None else on_host(x)


def _threads(x: Array) -> int:
    return THREADS if isinstance(x, np.ndarray) else int(array_namespace(x).get_num_threads())


def _transform(given: Array, axis: int, n: int | None, forward: bool) -> Array:
    x = given if isinstance(given, np.ndarray) else _on_host(given)
    if x is None:
        transform = array_namespace(given).fft
        return (transform.fft if forward else transform.ifft)(given, n=n, axis=axis)
    length = x.shape[axis] if n is None else n
    if length != x.shape[axis]:
        padded = list(x.shape)
        padded[axis] = length
        whole = np.zeros(padded, x.dtype)
        inside = [slice(None)] * x.ndim
        inside[axis] = slice(0, x.shape[axis])
        whole[tuple(inside)] = x
        x = whole
    out = x if length != given.shape[axis] else None  # in place where it is our own
    if _ducc is None:  # pragma: no cover
        return (_scipy.fft if forward else _scipy.ifft)(x, axis=axis, workers=THREADS)
    return of_kind(
        given,
        _ducc.c2c(
            x, axes=(axis,), forward=forward, inorm=0 if forward else 2, out=out, nthreads=_threads(given)
        ),
    )
