"""The description of a simulated bench: the nominal part that a person would write down, and its hidden defects.

The TOML form is bench.toml of a capture set plus `[[defect]]` tables and an optional `[simulation]` table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeVar

from firmware_iface.errors import InputError, nearest
from firmware_iface.toml_tables import check_instance, parameter, read_table
from firmware_iface.virtual.defect_kind import Defect
from firmware_iface.virtual.defects import read_defect

D = TypeVar("D", bound=Defect)


@dataclass(frozen=True)
class PanelDescription:
    """The phase panel; gray g asks for 2 pi g / levels."""

    width: int = parameter(320, "columns", 2, 8192)
    height: int = parameter(240, "rows", 2, 8192)
    pitch_um: float = parameter(8.0, "pixel pitch", 0.5, 200)
    levels: float = parameter(256.0, "gray levels of one wave", 1, 65536)
    fill_factor: float = parameter(1.0, "active share of a pixel's area", 0.05, 1)
    phase_sign: int = parameter(1, "-1 where more gray means less phase", choices=(1, -1))
    gray_levels: tuple[float, ...] = parameter((), "that it has; others are shown as the nearest of them")


@dataclass(frozen=True)
class ChannelDescription:
    """One laser."""

    name: str = parameter("green", "name of the colour")
    wavelength_nm: float = parameter(520.0, "wavelength", 200, 2000)


@dataclass(frozen=True)
class PropagationDescription:
    """Panel to image plane."""

    distance_mm: float = parameter(30.0, "panel to image plane", -2000, 2000)


@dataclass(frozen=True)
class IrisDescription:
    """The filter in the Fourier plane; what lies on the edges of a square passes."""

    shape: str = parameter("square", "outline", choices=("square", "circle"))
    half_width: float = parameter(1.0, "share of the panel's band 1 / (2 pitch)", 0.02, 2)


@dataclass(frozen=True)
class CameraDescription:
    """The camera; where it is not registered, `homography` leads from its pixels (x, y, 1) to the panel's."""

    width: int = parameter(320, "columns", 1, 16384)
    height: int = parameter(240, "rows", 1, 16384)
    pixel_um: float = parameter(8.0, "pixel, in the panel's plane", 0.1, 500)
    registered: bool = parameter(True, "camera pixel (i, j) is panel pixel (i, j)")
    bit_depth: int = parameter(12, "bits of a count", 4, 16)
    black_level: float = parameter(64.0, "counts without light", 0, 65535)
    full_well_e: float = parameter(10500.0, "electrons at full scale above black", 1, 1e9)
    read_noise_e: float = parameter(5.0, "electrons, standard deviation", 0, 1e6)
    homography: tuple[float, ...] = parameter((), "9 numbers, row-major")


@dataclass(frozen=True)
class SimulationDescription:
    """How the bench is simulated: settings that are not in a bench.toml."""

    subpixels: int = parameter(4, "samples drawn across a panel pixel", 2, 16)
    padding: float = parameter(2.0, "border, in units of the widest walk of light at the band's edge", 1, 20)
    signal_share: float = parameter(
        0.13, "share of full well for irradiance 1 at full power and 10 ms", 1e-6, 10
    )
    capture_interval_s: float = parameter(0.1, "time from one capture to the next", 0, 1e6)
    planes_mm: tuple[float, ...] = parameter((), "planes worth capturing; empty: the distance alone")


@dataclass(frozen=True)
class BenchDescription:
    """A simulated bench: nominal tables, hidden defects, simulation settings. Change it by dataclasses.replace."""

    name: str = "ideal"
    panel: PanelDescription = field(default_factory=PanelDescription)
    channels: tuple[ChannelDescription, ...] = (ChannelDescription(),)
    propagation: PropagationDescription = field(default_factory=PropagationDescription)
    iris: IrisDescription = field(default_factory=IrisDescription)
    camera: CameraDescription = field(default_factory=CameraDescription)
    simulation: SimulationDescription = field(default_factory=SimulationDescription)
    defects: tuple[Defect, ...] = ()

    def __post_init__(self) -> None:
        for table in ("panel", "propagation", "iris", "camera", "simulation"):
            check_instance(getattr(self, table), f"[{table}] of bench '{self.name}'")
        for i, channel in enumerate(self.channels):
            check_instance(channel, f"[[channel]] {i} of bench '{self.name}'")
        names = [c.name for c in self.channels]
        if not names:
            raise InputError(f"bench '{self.name}' has no channel; add a [[channel]].")
        if len(set(names)) != len(names):
            raise InputError(f"bench '{self.name}' has two channels of one name; rename one [[channel]].")
        kinds = [d.kind for d in self.defects]
        for defect in self.defects:
            check_instance(defect, f"[[defect]] '{defect.kind}' of bench '{self.name}'")
            if kinds.count(defect.kind) > 1:
                raise InputError(
                    f"bench '{self.name}' has two defects of kind '{defect.kind}'; keep one of them."
                )
        camera, panel = self.camera, self.panel
        grays = panel.gray_levels
        if grays and (
            len(grays) < 2 or any(not (g.is_integer() and 0 <= g <= 255) for g in map(float, grays))
        ):
            raise InputError(
                f"'gray_levels' in [panel] of bench '{self.name}' needs two or more whole numbers from 0 to 255."
            )
        if camera.registered and (camera.height, camera.width) != (panel.height, panel.width):
            raise InputError(
                f"[camera] of bench '{self.name}' is registered but not of the panel's size; "
                "make width and height equal or set registered = false and give a homography."
            )
        if not camera.registered and len(camera.homography) != 9:
            raise InputError(f"'homography' in [camera] of bench '{self.name}' needs 9 numbers, row by row.")
        if camera.black_level >= 2**camera.bit_depth - 1:
            raise InputError(
                f"'black_level' in [camera] of bench '{self.name}' is above full scale; lower it."
            )

    @property
    def planes_mm(self) -> tuple[float, ...]:
        """Planes worth capturing: the simulation's list, or the one distance."""
        return self.simulation.planes_mm or (self.propagation.distance_mm,)

    def defect(self, cls: type[D]) -> D | None:
        """The defect of this class, or None where the bench does not have it."""
        return next((d for d in self.defects if isinstance(d, cls)), None)

    def channel(self, name: str) -> ChannelDescription:
        """The channel of this name.

        Raises
        ------
        InputError
            For an unknown name; the message suggests the nearest.
        """
        for c in self.channels:
            if c.name == name:
                return c
        raise InputError(f"there is no channel '{name}'; {nearest(name, [c.name for c in self.channels])}")

    def resized(self, height: int, width: int, distance_mm: float | None = None) -> BenchDescription:
        """The same bench with another panel size, its camera to match, and another distance where one is given."""
        distance = (
            self.propagation if distance_mm is None else replace(self.propagation, distance_mm=distance_mm)
        )
        ratio = distance.distance_mm / self.propagation.distance_mm
        planes = tuple(round(z * ratio, 6) for z in self.simulation.planes_mm)
        return replace(
            self,
            panel=replace(self.panel, height=height, width=width),
            camera=replace(self.camera, height=height, width=width),
            propagation=distance,
            simulation=replace(self.simulation, planes_mm=planes),
        )

    def nominal(self) -> dict[str, Any]:
        """The tables of a bench.toml, without the defects and the bench's own name."""
        panel = asdict(self.panel)
        if self.panel.phase_sign == 1:
            del panel["phase_sign"]
        del panel["gray_levels"]
        if self.panel.gray_levels:
            panel["gray_levels"] = [int(gray) for gray in self.panel.gray_levels]
        camera = asdict(self.camera)
        camera["homography"] = list(self.camera.homography)
        if self.camera.registered:
            del camera["homography"]
        return {
            "schema": 1,
            "name": "virtual-bench",
            "panel": panel,
            "channel": [asdict(c) for c in self.channels],
            "propagation": asdict(self.propagation),
            "iris": asdict(self.iris),
            "camera": camera,
        }


def read_bench(tables: Mapping[str, Any], where: str) -> BenchDescription:
    """A bench from parsed TOML; tables that are left out take their defaults.

    Parameters
    ----------
    tables : mapping
        As read from TOML.
    where : str
        The file's name in messages.

    Returns
    -------
    BenchDescription

    Raises
    ------
    InputError
        For an unknown key, a wrong type, or a value out of range.
    """
    known = ("schema", "name", "panel", "channel", "propagation", "iris", "camera", "simulation", "defect")
    for key in tables:
        if key not in known:
            raise InputError(f"{where} has an unknown table '{key}'; {nearest(key, known)}")
    if tables.get("schema", 1) != 1:
        raise InputError(f"'schema' in {where} is {tables['schema']!r}; this version reads schema = 1.")
    for key in ("channel", "defect"):
        if not isinstance(tables.get(key, []), list):
            raise InputError(f"'{key}' in {where} is not a list; write [[{key}]] with two brackets.")
    panel = read_table(PanelDescription, tables.get("panel", {}), f"[panel] of {where}")
    camera_table = tables.get("camera", {})
    if isinstance(camera_table, Mapping) and camera_table.get("registered", True):
        camera_table = {
            "width": panel.width,
            "height": panel.height,
            "pixel_um": panel.pitch_um,
            **camera_table,
        }
    if isinstance(camera_table, Mapping) and isinstance(camera_table.get("homography"), list):
        rows = camera_table["homography"]
        flat = [v for row in rows for v in (row if isinstance(row, list) else [row])]
        camera_table = {**camera_table, "homography": flat}
    channels = tables.get("channel", [{}])
    return BenchDescription(
        name=str(tables.get("name", "unnamed")),
        panel=panel,
        channels=tuple(
            read_table(ChannelDescription, c, f"[[channel]] {i} of {where}") for i, c in enumerate(channels)
        ),
        propagation=read_table(
            PropagationDescription, tables.get("propagation", {}), f"[propagation] of {where}"
        ),
        iris=read_table(IrisDescription, tables.get("iris", {}), f"[iris] of {where}"),
        camera=read_table(CameraDescription, camera_table, f"[camera] of {where}"),
        simulation=read_table(
            SimulationDescription, tables.get("simulation", {}), f"[simulation] of {where}"
        ),
        defects=tuple(
            read_defect(d, f"[[defect]] {i} of {where}") for i, d in enumerate(tables.get("defect", []))
        ),
    )
