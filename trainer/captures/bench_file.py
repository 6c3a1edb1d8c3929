"""bench.toml: what is known of a bench before anything is measured, read strictly and written back.

Every key is checked for its type, its range and its spelling (`trainer.captures.bench_keys`). The message names the
table and the key, and says what is allowed.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.gray_levels import checked_gray_levels
from trainer.captures.bench_keys import (
    TOP_KEYS,
    KeyRule,
    Matrix,
    checked_matrix,
    checked_table,
    checked_value,
    printed,
    suggestion,
)


@dataclass(frozen=True)
class Channel:
    """One colour.

    Attributes
    ----------
    name : str
    wavelength_nm : float, nm
    """

    name: str
    wavelength_nm: float

    @property
    def wavelength(self) -> float:
        """Metres."""
        return self.wavelength_nm * 1e-9


@dataclass(frozen=True)
class Panel:
    """The phase panel (SLM). Gray g asks for the phase phase_sign * 2 pi g / levels in every channel.

    Attributes
    ----------
    width, height : int, pixels
    pitch_um : float, um
    levels : int
        Gray levels of one wave.
    fill_factor : float
        Share of a pixel's area that the pattern modulates.
    phase_sign : int
        1, or -1 where more gray means less phase.
    gray_levels : tuple of int
        Those that the panel has, where it has few: others are shown as the nearest of these. Empty: all.
    """

    width: int
    height: int
    pitch_um: float
    levels: int = 256
    fill_factor: float = 1.0
    phase_sign: int = 1
    gray_levels: tuple[int, ...] = ()

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
    """The filter in the Fourier plane.

    Attributes
    ----------
    shape : str
        "square" or "circle".
    half_width : float
        Share of the panel's band 1/(2 pitch).
    """

    shape: str = "square"
    half_width: float = 1.0


@dataclass(frozen=True)
class Camera:
    """The camera.

    Attributes
    ----------
    width, height : int, pixels
    pixel_um : float, um
        As it appears in the panel's plane.
    registered : bool
        Camera pixel (i, j) is panel pixel (i, j).
    bit_depth : int
    black_level : float, counts
    full_well_e : float, electrons
        At full scale above black.
    read_noise_e : float, electrons
    noise_stated : bool
        False where bench.toml leaves out full_well_e and read_noise_e, so that these are typical values.
    homography : 3 x 3 rows or None
        From a camera pixel's centre (x, y, 1) to panel pixels (x, y, 1); None when registered.
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
    noise_stated: bool = True

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), pixels."""
        return self.height, self.width

    def on_panel(self, y: Any, x: Any) -> tuple[Any, Any]:
        """Places on the camera as places on the panel.

        Parameters
        ----------
        y, x : arrays or tensors of one shape, camera pixels

        Returns
        -------
        y, x : of the same shape, panel pixels
        """
        if self.homography is None:
            return y, x
        h = self.homography
        w = h[2][0] * x + h[2][1] * y + h[2][2]
        return (h[1][0] * x + h[1][1] * y + h[1][2]) / w, (h[0][0] * x + h[0][1] * y + h[0][2]) / w

    def looks_at(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each pixel's centre looks.

        Returns
        -------
        y, x : float64 array [h, w], panel pixels
        """
        y, x = np.indices(self.shape, dtype=float)
        return self.on_panel(y, x)

    @property
    def saturation(self) -> int:
        """The top count; a pixel with this count is saturated."""
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
    """Everything in bench.toml.

    Attributes
    ----------
    name : str
    panel : Panel
    channels : tuple of Channel
    distance_mm : float, mm
        Panel to image plane.
    iris : Iris
    camera : Camera
    """

    name: str
    panel: Panel
    channels: tuple[Channel, ...]
    distance_mm: float
    iris: Iris
    camera: Camera

    def channel(self, name: str) -> Channel:
        """The channel of that name.

        Raises
        ------
        InputError
            If the bench has none.
        """
        for channel in self.channels:
            if channel.name == name:
                return channel
        names = [c.name for c in self.channels]
        raise InputError(f"the bench {self.name!r} has no channel {name!r}: use one of {', '.join(names)}")


def read_bench(source: Path | str | Mapping[str, Any]) -> Bench:
    """The bench of a bench.toml.

    Parameters
    ----------
    source : path or mapping
        The file, or its tables already parsed.

    Returns
    -------
    Bench

    Raises
    ------
    InputError
        If the file cannot be read or parsed, or a key is missing, unknown, of the wrong type or outside its physical
        range. The message names table.key and what is allowed there.
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
    if gray_levels := list(panel.pop("gray_levels")):
        panel["gray_levels"] = gray_levels
    if camera["homography"] is None:
        del camera["homography"]
    else:
        camera["homography"] = [list(row) for row in camera["homography"]]
    if not camera.pop("noise_stated"):
        del camera["full_well_e"], camera["read_noise_e"]
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
        if key not in TOP_KEYS:
            raise InputError(f"{printed(key)} is not known in bench.toml: {suggestion(key, TOP_KEYS)}")
    schema = tables.get("schema")
    if type(schema) is not int or schema != 1:
        raise InputError(f"schema is {printed(schema)}, but this reader knows schema 1: write schema = 1")
    name = checked_value("name", KeyRule(str), tables.get("name"))
    values = checked_table("panel", tables.get("panel"))
    values["gray_levels"] = checked_gray_levels(values["gray_levels"], "panel.gray_levels in bench.toml")
    panel = Panel(**values)
    rows = tables.get("channel")
    if not isinstance(rows, (list, tuple)) or not rows:
        raise InputError(
            "bench.toml has no [[channel]]: add one with a name and a wavelength_nm for each colour"
        )
    channels = tuple(Channel(**checked_table("channel", row)) for row in rows)
    names = [c.name for c in channels]
    for channel in names:
        if names.count(channel) > 1:
            raise InputError(f"channel.name {channel!r} is given twice: give every channel its own name")
    distance = checked_table("propagation", tables.get("propagation"))["distance_mm"]
    iris = Iris(**checked_table("iris", tables.get("iris", {})))
    camera = _camera(checked_table("camera", tables.get("camera")), tables["camera"], panel)
    return Bench(name, panel, channels, distance, iris, camera)


def _camera(values: dict[str, Any], given_table: Mapping[str, Any], panel: Panel) -> Camera:
    missing = [key for key in ("full_well_e", "read_noise_e") if key not in given_table]
    if len(missing) == 1:
        raise InputError(
            f"camera.{missing[0]} is missing in bench.toml: write full_well_e and read_noise_e, both in electrons, or "
            "leave out both to have them measured from repeated captures"
        )
    values["noise_stated"] = not missing
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
                "camera.homography is given with registered = true: remove it, or write registered = false"
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
    return Camera(**{**values, "homography": checked_matrix(given)})
