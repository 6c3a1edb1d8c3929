"""The panel's spectrum where only the beam has changed, without the panel's crosstalk computed anew.

Crosstalk parts each pixel into many sub-pixels, which makes a panel several times as slow. A beam is smooth:
multiplying it over whole pixels instead of sub-pixels errs by what it changes within half a pixel.
"""

from __future__ import annotations

import torch
from torch import Tensor

from runtime.lightpath.fft import ifft
from runtime.lightpath.light_path import LightPath, aperture_spectrum, field_spectrum


def spectra_of_other_beam(before: LightPath, path: LightPath, spectra: Tensor) -> Tensor | None:
    """Spectra of a panel that differs from another one in the beam alone.

    Exact where the beam is the same; else the change errs by a share of about the beam's own change over half a pixel,
    which a derivative may.

    Parameters
    ----------
    before : LightPath
        That gave `spectra`.
    path : LightPath
        With the same drive.
    spectra : complex Tensor [..., n, m]

    Returns
    -------
    complex Tensor [..., n, m] or None
        None where the pixels' aperture differs, or where without crosstalk the spectrum itself is as quick.
    """
    if not all(
        torch.equal(_tensor(a), _tensor(b)) for a, b in zip(before.aperture, path.aperture, strict=True)
    ):
        return None
    same_leak = _same(before.leak, path.leak)
    if same_leak and _same(before.source, path.source):
        return spectra
    if path.crosstalk is None:
        return None
    height, width = path.grid.shape
    even = _field(before, spectra)[..., :height, :width]
    modulated = even if before.leak is None else even - before.leak
    least = torch.finfo(modulated.dtype).tiny
    ratio = path.source * before.source.conj() / (before.source.abs() ** 2).clamp(min=least)
    change = modulated * (ratio - 1)
    if not same_leak:
        change = change + _of(path.leak) - _of(before.leak)
    return spectra + field_spectrum(path, change, path.response)


def _field(path: LightPath, spectra: Tensor) -> Tensor:
    """The field, even over each pixel, that has these spectra within the panel's own band."""
    even = spectra / aperture_spectrum(path, path.response, (1, 1))
    for axis in (0, 1):
        even = _along(even, path.grid.band[axis], path.grid.padded[axis], axis - 2)
    return even


def _along(spectra: Tensor, band: int, period: int, axis: int) -> Tensor:
    """Inverse DFT along an axis of frequencies -band to band, of those that one period of the pixels holds."""
    low, high = -min(band, period // 2), min(band, (period - 1) // 2)
    negative = spectra.narrow(axis, band + low, -low)
    positive = spectra.narrow(axis, band, high + 1)
    shape = list(spectra.shape)
    shape[axis] = period - (high + 1 - low)
    return ifft(torch.cat((positive, spectra.new_zeros(shape), negative), axis), axis=axis, n=period)


def _same(one: Tensor | None, other: Tensor | None) -> bool:
    return one is other or (one is not None and other is not None and torch.equal(one, other))


def _of(leak: Tensor | None) -> Tensor | float:
    return 0.0 if leak is None else leak


def _tensor(side: Tensor | float) -> Tensor:
    return torch.as_tensor(side)
