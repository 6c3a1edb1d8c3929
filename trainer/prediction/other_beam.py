"""The panel's spectrum where only the beam has changed, without the panel's crosstalk computed anew.

Crosstalk parts each pixel into many sub-pixels, which makes a panel several times as slow. A beam is smooth:
multiplying it over whole pixels instead of sub-pixels errs by what it changes within half a pixel.
"""

from __future__ import annotations

import torch
from torch import Tensor

from runtime.lightpath.fft import ifft
from runtime.lightpath.light_path import LightPath, aperture_spectrum, field_spectrum
from runtime.lightpath.periodic_axis import put, ring


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
    if before.aperture != path.aperture:
        return None
    if same(before.leak, path.leak) and same(before.source, path.source):
        return spectra
    if path.crosstalk is None:
        return None
    old_leak, leak = (0.0 if p.leak is None else p.leak for p in (before, path))
    modulated = _field(before, spectra) - old_leak
    least = torch.finfo(modulated.dtype).tiny
    ratio = path.source * before.source.conj() / (before.source.abs() ** 2).clamp(min=least)
    return spectra + field_spectrum(path, modulated * (ratio - 1) + leak - old_leak, path.response)


def _field(path: LightPath, spectra: Tensor) -> Tensor:
    """The field [..., H, W], even over each pixel, that has these spectra within the panel's own band."""
    field: Tensor = spectra / aperture_spectrum(path, path.response, (1, 1))
    for axis, band, period, size in zip(
        (-2, -1), path.grid.band, path.grid.padded, path.grid.shape, strict=True
    ):
        # One period of frequencies is all that pixels tell apart.
        low, high = -min(band, period // 2), min(band, (period - 1) // 2)
        inside = field.narrow(axis, band + low, high - low + 1)
        whole = put(inside, ring(low, high - low + 1, period), axis, period)
        field = ifft(whole, axis=axis).narrow(axis, 0, size)
    return field


def same(one: Tensor | None, other: Tensor | None) -> bool:
    """Whether two tensors are one, or have the same numbers."""
    return one is other or (one is not None and other is not None and torch.equal(one, other))
