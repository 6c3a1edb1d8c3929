"""bench.toml: what is known of a bench before anything is measured, read strictly and written back.

Every key is checked for its type, its range and its spelling; the message names the table and the key, and
says what is allowed.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError

Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Channel:
    """One colour. wavelength_nm : float, nm."""

    name: str
    wavelength_nm: float

    @property
    def wavelength(self) -> float:
        """Metres."""
        return self.wavelength_nm * 1e-9


@dataclass(frozen=True)
class Panel:
    """The phase panel. Gray g asks for the phase phase_sign * 2 pi g / levels in every channel.

    pitch_um : float, um
    fill_factor : float, share of a pixel's area that the pattern modulates
    """

    width: int
    height: int
    pitch_um: float
    levels: int = 256
    fill_factor: float = 1.0
    phase_sign: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), pixels."""
        return self.height, self.width

    @property
    def pitch(self) -> float:
        """Metres."""
        return self.pitch_um * 1e-6


@dataclass(frozen=True)
class Iris:
    """The filter in the Fourier plane. half_width : float, share of the panel's band 1/(2 pitch)."""

    shape: str = "square"
    half_width: float = 1.0


@dataclass(frozen=True)
class Camera:
    """The camera. pixel_um in um; black_level in counts; full_well_e and read_noise_e in electrons.

    registered : camera pixel (i, j) is panel pixel (i, j)
    homography : 3 x 3 rows, camera pixel centre (x, y, 1) to panel pixels (x, y, 1); None when registered
    """

    width: int
    height: int
    pixel_um: float
    registered: bool
    bit_depth: int
    black_level: float
    full_well_e: float
    read_noise_e: float
    homography: Matrix | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), pixels."""
        return self.height, self.width

    def on_panel(self, y: Any, x: Any) -> tuple[Any, Any]:
        """Places on the camera (pixels; arrays or tensors of one shape) as places on the panel (y, x), panel pixels."""
        if self.homography is None:
            return y, x
        h = self.homography
        w = h[2][0] * x + h[2][1] * y + h[2][2]
        return (h[1][0] * x + h[1][1] * y + h[1][2]) / w, (h[0][0] * x + h[0][1] * y + h[0][2]) / w

    def looks_at(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each pixel's centre looks, in panel pixels: (y, x), each float64 [h, w]."""
        y, x = np.indices(self.shape, dtype=float)
        return self.on_panel(y, x)

    @property
    def saturation(self) -> int:
        """The top count; a pixel that shows it says nothing."""
        return 2**self.bit_depth - 1

    @property
    def full_scale(self) -> float:
        """Counts above black at the top of the range."""
        return self.saturation - self.black_level

    @property
    def counts_per_electron(self) -> float:
        """Counts that one electron adds."""
        return self.full_scale / self.full_well_e


@dataclass(frozen=True)
class Bench:
    """Everything in bench.toml. distance_mm : float, panel to image plane, mm."""

    name: str
    panel: Panel
    channels: tuple[Channel, ...]
    distance_mm: float
    iris: Iris
    camera: Camera

    def channel(self, name: str) -> Channel:
        """The channel of that name. Raises InputError if the bench has none."""
        for channel in self.channels:
            if channel.name == name:
                return channel
        names = [c.name for c in self.channels]
        raise InputError(f"the bench {self.name!r} has no channel {name!r}: use one of {', '.join(names)}")


@dataclass(frozen=True)
class _Key:
    """What a key may hold: its type, its closed range (low may be excluded), its choices, its default."""

    kind: type
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    choices: tuple[Any, ...] = ()
    default: Any = None
    unit: str = ""

    def allowed(self) -> str:
        if self.choices:
            return "one of " + ", ".join(repr(c) if isinstance(c, str) else str(c) for c in self.choices)
        if self.kind is bool:
            return "true or false"
        if self.kind is str:
            return "text of 1 to 200 characters"
        name = "a whole number" if self.kind is int else "a number"
        start = f"above {self.low:g} and up to" if self.above else f"from {self.low:g} to"
        return f"{name} {start} {self.high:g}{' ' + self.unit if self.unit else ''}"


_TABLES: dict[str, dict[str, _Key]] = {
    "panel": {
        "width": _Key(int, 2, 16384),
        "height": _Key(int, 2, 16384),
        "pitch_um": _Key(float, 0.05, 1000, unit="um"),
        "levels": _Key(int, 2, 65536, default=256),
        "fill_factor": _Key(float, 0, 1, above=True, default=1.0),
        "phase_sign": _Key(int, choices=(1, -1), default=1),
    },
    "channel": {"name": _Key(str), "wavelength_nm": _Key(float, 100, 20000, unit="nm")},
    "propagation": {"distance_mm": _Key(float, -1e4, 1e4, unit="mm")},
    "iris": {
        "shape": _Key(str, choices=("square", "circle"), default="square"),
        "half_width": _Key(float, 0, 4, above=True, default=1.0),
    },
    "camera": {
        "width": _Key(int, 2, 16384),
        "height": _Key(int, 2, 16384),
        "pixel_um": _Key(float, 0.05, 1000, unit="um"),
        "registered": _Key(bool),
        "bit_depth": _Key(int, 4, 16),
        "black_level": _Key(float, 0, 65534, unit="counts"),
        "full_well_e": _Key(float, 1, 1e9, unit="electrons"),
        "read_noise_e": _Key(float, 0, 1e6, unit="electrons"),
        "homography": _Key(list),
    },
}
_TOP = ("schema", "name", "panel", "channel", "propagation", "iris", "camera")


def read_bench(source: Path | str | Mapping[str, Any]) -> Bench:
    """The bench of a bench.toml, or of its tables already parsed.

    Raises InputError, naming table.key and what is allowed there, if the file cannot be read or parsed, a
    key is missing, unknown, of the wrong type or outside its physical range.
    """
    if isinstance(source, Mapping):
        return _bench(source)
    path = Path(source)
    try:
        tables = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): a bench needs its bench.toml") from None
    except (ValueError, RecursionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise InputError(f"{path} is not TOML ({reason}): correct that line") from None
    try:
        return _bench(tables)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def bench_tables(bench: Bench) -> dict[str, Any]:
    """The tables of bench.toml that describe a bench; `read_bench` of them gives the bench back."""
    panel, camera = dict(vars(bench.panel)), dict(vars(bench.camera))
    if camera["homography"] is None:
        del camera["homography"]
    else:
        camera["homography"] = [list(row) for row in camera["homography"]]
    return {
        "schema": 1,
        "name": bench.name,
        "panel": panel,
        "channel": [dict(vars(c)) for c in bench.channels],
        "propagation": {"distance_mm": bench.distance_mm},
        "iris": dict(vars(bench.iris)),
        "camera": camera,
    }


def _bench(tables: Mapping[str, Any]) -> Bench:
    for key in tables:
        if key not in _TOP:
            raise InputError(f"{_shown(key)} is not known in bench.toml: {_suggest(key, _TOP)}")
    schema = tables.get("schema")
    if type(schema) is not int or schema != 1:
        raise InputError(f"schema is {_shown(schema)}, but this reader knows schema 1: write schema = 1")
    name = _value("name", _Key(str), tables.get("name"))
    panel = Panel(**_table("panel", tables.get("panel")))
    rows = tables.get("channel")
    if not isinstance(rows, (list, tuple)) or not rows:
        raise InputError(
            "bench.toml has no [[channel]]: add one with a name and a wavelength_nm for each colour"
        )
    channels = tuple(Channel(**_table("channel", row)) for row in rows)
    names = [c.name for c in channels]
    for channel in names:
        if names.count(channel) > 1:
            raise InputError(f"channel.name {channel!r} is given twice: give every channel its own name")
    distance = _table("propagation", tables.get("propagation"))["distance_mm"]
    iris = Iris(**_table("iris", tables.get("iris", {})))
    camera = _camera(_table("camera", tables.get("camera")), panel)
    return Bench(name, panel, channels, distance, iris, camera)


def _camera(values: dict[str, Any], panel: Panel) -> Camera:
    camera = Camera(**{**values, "homography": None})
    if camera.black_level >= camera.saturation:
        raise InputError(
            f"camera.black_level is {camera.black_level:g}, but bit_depth = {camera.bit_depth} "
            f"ends at {camera.saturation}: write the dark picture's mean count"
        )
    if camera.read_noise_e >= camera.full_well_e:
        raise InputError(
            f"camera.read_noise_e is {camera.read_noise_e:g}, not below full_well_e = "
            f"{camera.full_well_e:g}: write both in electrons"
        )
    given = values.get("homography")
    if camera.registered:
        if given is not None:
            raise InputError(
                "camera.homography is given with registered = true: take it out, or write registered = false"
            )
        if camera.shape != panel.shape:
            raise InputError(
                f"camera.width and height are {camera.width} x {camera.height} but the panel's are "
                f"{panel.width} x {panel.height}, though registered = true says that they are the same "
                "pixels: turn or crop the images, or write registered = false with a homography"
            )
        return camera
    if given is None:
        raise InputError(
            "camera.homography is missing: with registered = false, give the 3 x 3 matrix from "
            "the centre of a camera pixel (x, y, 1) to panel pixels"
        )
    return Camera(**{**values, "homography": _matrix(given)})


def _matrix(given: Any) -> Matrix:
    rows = given
    if isinstance(given, (list, tuple)) and len(given) == 9:
        rows = [given[0:3], given[3:6], given[6:9]]
    wrong = InputError(
        "camera.homography is not an invertible 3 x 3 matrix of finite numbers: "
        "write [[a, b, c], [d, e, f], [g, h, i]], one list a row"
    )
    if not isinstance(rows, (list, tuple)) or len(rows) != 3:
        raise wrong
    flat: list[float] = []
    for row in rows:
        if not isinstance(row, (list, tuple)) or len(row) != 3:
            raise wrong
        for value in row:
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= 1e12:
                raise wrong
            flat.append(float(value))
    a, b, c, d, e, f, g, h, i = flat
    scale = max(map(abs, flat)) or 1.0
    if abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)) <= 1e-15 * scale**3:
        raise wrong
    return (a, b, c), (d, e, f), (g, h, i)


def _table(table: str, given: Any) -> dict[str, Any]:
    """A table's values, checked, with its defaults filled in."""
    keys = _TABLES[table]
    header = "[[channel]]" if table == "channel" else f"[{table}]"
    if not isinstance(given, Mapping):
        raise InputError(f"bench.toml has no table {header}: add it with {', '.join(keys)}")
    for key in given:
        if key not in keys:
            raise InputError(
                f"{table}.{str(key)[:60]} is not known in bench.toml: {_suggest(key, tuple(keys))}"
            )
    return {key: _value(f"{table}.{key}", rule, given.get(key)) for key, rule in keys.items()}


def _value(where: str, rule: _Key, given: Any) -> Any:
    if given is None and (rule.default is not None or rule.kind is list):
        return rule.default
    if rule.kind is list:
        return given
    if given is None:
        raise InputError(f"{where} is missing in bench.toml: write {rule.allowed()}")
    kinds = (int, float) if rule.kind is float else (rule.kind,)
    good = isinstance(given, kinds) and (rule.kind is bool or not isinstance(given, bool))
    if good and rule.choices:
        good = given in rule.choices
    elif good and rule.kind is str:
        good = bool(given.strip()) and len(given) <= 200 and given.isprintable()
    elif good and rule.kind in (int, float):
        good = rule.low <= given <= rule.high and not (rule.above and given == rule.low)
    if not good:
        raise InputError(f"{where} is {_shown(given)}: write {rule.allowed()}")
    return float(given) if rule.kind is float else given


def _shown(value: Any) -> str:
    try:
        return repr(value)[:60]
    except ValueError:  # a whole number too long to print
        return "a number too long to print"


def _suggest(key: str, known: tuple[str, ...]) -> str:
    near = get_close_matches(str(key), known, 1)
    return f"did you mean {near[0]!r}?" if near else f"use {', '.join(known)}, or take it out"
