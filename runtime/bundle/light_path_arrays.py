"""Light paths in a bundle: how each colour and plane's arrays are named, written and read back.

`bundle.json`'s description holds, besides the panel, one record a colour and plane:

    {"channel", "plane_mm", "wavelength_nm",
     "grid": {"shape", "padded", "margin", "band", "pitch_m", "samples_a_pixel"},
     "arrays": {field of LightPath: name of an array}}

`samples_a_pixel` (along an axis, of irradiance) is there where it is not 2.
Fields that are None in a LightPath are not listed; `crosstalk` is two arrays, crosstalk_rows and
crosstalk_columns, and `modulation` three: modulation_ends, modulation_factors and modulation_shares. A modulation over
the phase on the panel, after the gain, has "modulation_by_phase": true beside the arrays.
Arrays that several planes or colours share are stored once. Where the panel has few gray levels, the description's
`panel` lists them as `gray_levels`: a light path's response is then of these alone, so that solvers see them. Where
it is slow, `panel` has `slow_response_share` (unit 1): of the phase before, what is left when a pattern was shown for
one period of the panel. Light paths are for patterns that stay.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from firmware_iface.errors import InputError, nearest
from runtime.bundle.bundle_folder import ARRAYS, MANIFEST, Bundle
from runtime.lightpath.gray_levels import checked_gray_levels, shown_as
from runtime.lightpath.grid import COARSE, FINE, FINEST, Grid
from runtime.lightpath.light_path import LightPath

COMPLEX, REAL = np.dtype(np.complex64), np.dtype(np.float32)
NEEDED = ("response", "source", "transfers", "weights", "aperture")
CROSSTALK = ("crosstalk_rows", "crosstalk_columns")
MODULATION = ("modulation_ends", "modulation_factors", "modulation_shares")
OPTIONAL = ("gain", "leak", *CROSSTALK, *MODULATION, "irradiance_filter")
TYPES = {
    "source": COMPLEX,
    "leak": COMPLEX,
    "transfers": COMPLEX,
    "modulation_factors": COMPLEX,
}  # the filter is either; all others are real
LARGEST = 1 << 15  # samples an axis

Record = dict[str, Any]


def pack_light_paths(
    paths: Iterable[tuple[str, float, float, LightPath]],
) -> tuple[list[Record], dict[str, np.ndarray]]:
    """Records and arrays of light paths.

    Parameters
    ----------
    paths : iterable of (str, float, float, LightPath)
        Channel, plane (mm), wavelength (nm), and the path on NumPy arrays.

    Returns
    -------
    records : list of dict
    arrays : dict of str to array
        float32 and complex64; equal ones are kept once, under the name of the first path that has them.
    """
    records: list[Record] = []
    arrays: dict[str, np.ndarray] = {}
    known: dict[tuple[str, bytes], str] = {}
    for channel, plane_mm, wavelength_nm, path in paths:
        names = {}
        for field, array in _fields(path).items():
            array = np.ascontiguousarray(array, COMPLEX if np.iscomplexobj(array) else REAL)
            key = (f"{field}{array.shape}{array.dtype}", array.tobytes())
            if key not in known:
                known[key] = f"{field}.{channel}.{plane_mm:g}mm"
                arrays[known[key]] = array
            names[field] = known[key]
        grid = path.grid
        records.append(
            {
                "channel": channel,
                "plane_mm": float(plane_mm),
                "wavelength_nm": float(wavelength_nm),
                "grid": {
                    "shape": list(grid.shape),
                    "padded": list(grid.padded),
                    "margin": grid.margin,
                    "band": list(grid.band),
                    "pitch_m": grid.pitch,
                    **({} if grid.fine == FINE else {"samples_a_pixel": grid.fine}),
                },
                **({"modulation_by_phase": True} if path.modulation_by_phase else {}),
                "arrays": names,
            }
        )
    return records, arrays


def _fields(path: LightPath) -> dict[str, np.ndarray]:
    """The arrays that a light path has, by field."""
    fields = {
        "response": path.response,
        "source": path.source,
        "transfers": path.transfers,
        "weights": path.weights,
        "aperture": np.array([float(side) for side in path.aperture]),
        "gain": path.gain,
        "leak": path.leak,
        "irradiance_filter": path.irradiance_filter,
    }
    if path.crosstalk is not None:
        fields.update(zip(CROSSTALK, path.crosstalk, strict=True))
    if path.modulation is not None:
        fields.update(zip(MODULATION, path.modulation, strict=True))
    return {name: array for name, array in fields.items() if array is not None}


def bundle_paths(bundle: Bundle) -> list[Record]:
    """The records of all light paths in a bundle.

    Raises
    ------
    InputError
        Where there are none.
    """
    records = bundle.description.get("paths")
    if not isinstance(records, list) or not records or not all(isinstance(r, dict) for r in records):
        raise InputError(f"{MANIFEST} describes no light paths: export the bundle again")
    for number, record in enumerate(records):
        channel, plane = record.get("channel"), record.get("plane_mm")
        if not isinstance(channel, str) or not _is_number(plane):
            raise InputError(
                f"light path {number} of {MANIFEST} has no channel or no plane_mm: export it again"
            )
    return records


def bundle_channels(bundle: Bundle) -> list[str]:
    """Names of a bundle's colours, in its own order."""
    return list(dict.fromkeys(r["channel"] for r in bundle_paths(bundle)))


def load_light_path(bundle: Bundle, channel: str | None = None, plane_mm: float | None = None) -> LightPath:
    """The light path of one colour and plane of a bundle, on NumPy arrays.

    Parameters
    ----------
    bundle : Bundle
    channel : str or None
        None is enough where the bundle has one colour.
    plane_mm : float or None, mm
        None: the bench's own distance if the bundle has it, else the colour's first plane.

    Returns
    -------
    LightPath

    Raises
    ------
    InputError
        For a colour or plane that the bundle lacks, and where its arrays do not fit together.
    """
    record = _find(bundle, channel, plane_mm)
    where = f"light path {record['channel']}, {record['plane_mm']:g} mm"
    grid = _grid(record.get("grid"), where)
    names = record.get("arrays")
    if not isinstance(names, Mapping):
        raise InputError(f"{MANIFEST}: {where} lists no arrays: export the bundle again")
    for field in names:
        if field not in NEEDED + OPTIONAL:
            raise InputError(f"{MANIFEST}: {where} has an array '{field}' that this release does not know")
    arrays = {field: _array(bundle, names.get(field), field, where) for field in NEEDED + OPTIONAL}
    _check_shapes(arrays, grid, where)
    response, gray_levels, levels = arrays["response"], *_gray_levels(bundle)
    if response is not None and gray_levels:
        if response.size < 256:
            raise InputError(
                f"{MANIFEST} lists gray levels and {where} has {response.size}: export the bundle again"
            )
        response = response[shown_as(gray_levels, levels)]
    rows, columns = (arrays[name] for name in CROSSTALK)
    ends, factors, shares = (arrays[name] for name in MODULATION)
    by_phase = record.get("modulation_by_phase", False)
    if not isinstance(by_phase, bool):
        raise InputError(
            f"{MANIFEST}: modulation_by_phase of {where} is not true or false: export the bundle again"
        )
    return LightPath(
        grid=grid,
        response=response,
        source=arrays["source"],
        transfers=arrays["transfers"],
        weights=arrays["weights"],
        gain=arrays["gain"],
        crosstalk=None if rows is None or columns is None else (rows, columns),
        leak=arrays["leak"],
        aperture=(arrays["aperture"][0], arrays["aperture"][1]),  # type: ignore[index]
        irradiance_filter=arrays["irradiance_filter"],
        modulation=None if ends is None or factors is None or shares is None else (ends, factors, shares),
        modulation_by_phase=by_phase,
        gray_levels=gray_levels,
    )


def _gray_levels(bundle: Bundle) -> tuple[tuple[int, ...], float]:
    """The gray levels that the bundle's panel has, none: all; and how many make one wave."""
    panel = bundle.description.get("panel")
    panel = panel if isinstance(panel, Mapping) else {}
    levels = panel.get("levels", 256)
    if not _is_number(levels) or levels < 1:
        raise InputError(f"{MANIFEST}: 'levels' of its panel is {levels!r}: export the bundle again")
    return checked_gray_levels(panel.get("gray_levels"), f"'gray_levels' in {MANIFEST}"), levels


def slow_response_share(bundle: Bundle) -> float:
    """Share of the phase before that a bundle's panel keeps until a pattern's time is over; 0 where it is not slow.

    Raises
    ------
    InputError
        Unless it is from 0 to less than 1.
    """
    panel = bundle.description.get("panel")
    share: Any = panel.get("slow_response_share", 0.0) if isinstance(panel, Mapping) else 0.0
    if not _is_number(share) or not 0 <= share < 1:
        raise InputError(
            f"{MANIFEST}: 'slow_response_share' of its panel is {share!r}, and a share is from 0 to less than 1: "
            "export the bundle again"
        )
    return float(share)


def plane_of(bundle: Bundle, channel: str | None = None, plane_mm: float | None = None) -> float:
    """The plane (mm) of what `load_light_path` returns for the same arguments, with the same errors."""
    return float(_find(bundle, channel, plane_mm)["plane_mm"])


def _find(bundle: Bundle, channel: str | None, plane_mm: float | None) -> Record:
    records, channels = bundle_paths(bundle), bundle_channels(bundle)
    if channel is None:
        if len(channels) > 1:
            raise InputError(f"the bundle has several channels: choose one of {', '.join(channels)}")
        channel = channels[0]
    if channel not in channels:
        raise InputError(f"the bundle has no channel '{channel}': {nearest(channel, channels)}")
    here = [r for r in records if r["channel"] == channel]
    if plane_mm is None:
        own: Any = bundle.description.get("distance_mm")
        return next((r for r in here if _is_number(own) and _same(r["plane_mm"], own)), here[0])
    for record in here:
        if _same(record["plane_mm"], plane_mm):
            return record
    planes = ", ".join(f"{r['plane_mm']:g}" for r in here)
    raise InputError(
        f"the bundle has no plane at {plane_mm:g} mm for {channel}: use one of {planes}, or export it"
    )


def _same(a: float, b: float) -> bool:
    return abs(a - b) <= 1e-6 * max(1.0, abs(a))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _grid(given: Any, where: str) -> Grid:
    wrong = InputError(f"{MANIFEST}: the grid of {where} cannot be computed: export the bundle again")
    if not isinstance(given, Mapping):
        raise wrong

    def pair(key: str) -> tuple[int, int]:
        value = given.get(key)
        if not isinstance(value, list) or len(value) != 2 or not all(type(n) is int for n in value):
            raise wrong
        return value[0], value[1]

    shape, padded, band = pair("shape"), pair("padded"), pair("band")
    margin: Any = given.get("margin")
    fine: Any = given.get("samples_a_pixel", FINE)
    pitch: Any = given.get("pitch_m")
    if type(margin) is not int or margin < 0 or not _is_number(pitch) or not 0 < pitch < 1:
        raise wrong
    if type(fine) is not int or fine not in (COARSE, FINE, FINEST):
        raise wrong
    for n, room, edge in zip(shape, padded, band, strict=True):
        if not (n >= 1 and n + 2 * margin <= room <= LARGEST and 0 <= edge < room):
            raise wrong
    return Grid(shape, padded, margin, band, float(pitch), fine)


def _array(bundle: Bundle, name: Any, field: str, where: str) -> np.ndarray | None:
    if name is None:
        if field in NEEDED:
            raise InputError(f"{MANIFEST}: {where} has no {field}: export the bundle again")
        return None
    if name not in bundle.arrays:
        raise InputError(f"{ARRAYS} has no array '{name}', which {where} needs: export the bundle again")
    array = bundle.arrays[name]
    wanted = {COMPLEX, REAL} if field == "irradiance_filter" else {TYPES.get(field, REAL)}
    if array.dtype not in wanted:
        types = " or ".join(sorted(str(d) for d in wanted))
        raise InputError(f"{ARRAYS}: '{name}' is {array.dtype}, and {field} of {where} must be {types}")
    return array


def _check_shapes(arrays: Mapping[str, np.ndarray | None], grid: Grid, where: str) -> None:
    height, width = grid.image_shape
    response, weights = arrays["response"], arrays["weights"]
    levels = 256 if response is None else max(2, min(response.size, 256))
    modes = 1 if weights is None else weights.size
    shapes: dict[str, tuple[int, ...]] = {
        "response": (levels,),
        "weights": (modes,),
        "aperture": (2,),
        "source": grid.shape,
        "gain": grid.shape,
        "leak": grid.shape,
        "transfers": (modes, 2 * grid.band[0] + 1, 2 * grid.band[1] + 1),
        "irradiance_filter": (height, width // 2 + 1),
    }
    for field, shape in shapes.items():
        array = arrays[field]
        if array is not None and array.shape != shape:
            raise InputError(f"{ARRAYS}: {field} of {where} has the shape {array.shape}, expected {shape}")
    for field in ("crosstalk_rows", "crosstalk_columns"):
        taps = arrays[field]
        if taps is not None and (taps.ndim != 2 or taps.shape[1] % 2 == 0 or taps.shape[0] > 4 * FINE**2):
            raise InputError(f"{ARRAYS}: {field} of {where} is not a table [sub-pixels, odd number of taps]")
    if (arrays["crosstalk_rows"] is None) != (arrays["crosstalk_columns"] is None):
        raise InputError(f"{MANIFEST}: {where} has crosstalk along one axis only: export the bundle again")
    ends, factors, shares = (arrays[name] for name in MODULATION)
    if ends is None and factors is None and shares is None:
        return
    if ends is None or factors is None or shares is None:
        raise InputError(f"{MANIFEST}: {where} has only parts of a modulation: export the bundle again")
    if (
        ends.shape != (2,)
        or not ends[0] < ends[1]
        or factors.ndim != 2
        or factors.shape[1] < 2
        or shares.shape != factors.shape[:1]
    ):
        raise InputError(
            f"{ARRAYS}: the modulation of {where} is not two phases, a table [states, phases] and a share a state: "
            "export the bundle again"
        )
