"""A field that was measured on a real bench, put on a simulated panel as it is: the beam's amplitude and the phase.

Arrays are [row, column] and reach from edge to edge of the panel, whatever their size.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError
from firmware_iface.toml_tables import parameter
from firmware_iface.virtual.defect_kind import Defect

Array = NDArray[np.float64]
SAME_WAVELENGTH_NM = 1.0  # a wrapped phase cannot be scaled to another wavelength


@dataclass(frozen=True)
class MeasuredField(Defect):
    """Beam and shape of a real panel, from an NPZ file; mean power over the panel is kept."""

    kind = "measured_field"
    stage = "panel"
    file: str = parameter("", "NPZ file, from the folder of this TOML file; empty: none")
    amplitude: str = parameter("amplitude", "name of the beam's amplitude in the file; empty: uniform")
    phase: str = parameter("phase_rad", "name of the phase in the file, rad, wrapped or not; empty: flat")
    wavelength_nm: float = parameter(520.0, "at which the phase was measured", 200, 2000)


def measured_field(
    d: MeasuredField | None, wavelength_nm: float, height: int, width: int
) -> tuple[Array, NDArray[np.complex128]]:
    """Amplitude of the beam, of mean square 1, and exp(j phase), each [height, width], or [1, 1] without a file.

    Raises
    ------
    InputError
        Where the file does not hold the field, or the field was measured at another wavelength.
    """
    amplitude, turn = np.ones((1, 1)), np.ones((1, 1), np.complex128)
    if d is None or not d.file:
        return amplitude, turn
    if d.amplitude:
        amplitude = np.clip(_resized(_array(d, d.amplitude), height, width).real, 0, None)
        if not amplitude.any():
            raise InputError(f"'{d.amplitude}' of {d.file} is dark everywhere; give the beam's amplitude.")
    if d.phase:
        if abs(wavelength_nm - d.wavelength_nm) > SAME_WAVELENGTH_NM:
            raise InputError(
                f"the phase of {d.file} was measured at {d.wavelength_nm:g} nm and the bench has {wavelength_nm:g} nm; "
                "set the channel's wavelength_nm, or wavelength_nm of the defect."
            )
        turn = _resized(np.exp(1j * _array(d, d.phase)), height, width)
        turn = turn / np.maximum(np.abs(turn), 1e-9)
    return amplitude / np.sqrt(np.mean(amplitude**2)), turn


def _array(d: MeasuredField, name: str) -> Array:
    try:
        with np.load(Path(d.file), allow_pickle=False) as arrays:
            if name not in arrays:
                raise InputError(f"{d.file} has no array '{name}'; it has {', '.join(arrays)}.")
            values = np.asarray(arrays[name])
    except (OSError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{d.file} cannot be read as an NPZ file ({error}); give the measured field."
        ) from None
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise InputError(f"'{name}' of {d.file} is not a picture of finite numbers; correct it.")
    return values.astype(np.float64)


def _resized(values: NDArray[np.complex128] | Array, height: int, width: int) -> NDArray[np.complex128]:
    """Values between those of cell centres, linear along each axis."""
    out = np.asarray(values, np.complex128)
    for axis, size in enumerate((height, width)):
        there = out.shape[axis]
        at = np.clip((np.arange(size) + 0.5) / size * there - 0.5, 0, there - 1)
        low = np.minimum(at.astype(np.int64), max(there - 2, 0))
        share = (at - low)[:, None] if axis == 0 else (at - low)[None, :]
        high = np.minimum(low + 1, there - 1)
        out = np.take(out, low, axis) * (1 - share) + np.take(out, high, axis) * share
    return out
