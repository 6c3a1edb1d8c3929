"""Open the devices that a configuration names: one table and one function for each.

[panel]                       a panel board over USB (firmware_iface/panel/PROTOCOL.md)
kind = "board"                or "dlpc900", TI's phase light modulator, or "mirrored", a panel that is a screen, or
                              "MODULE:FUNCTION", a function of yours that opens one (firmware_iface.own_device)
bus = "virtual:SOCKET"        emulated hardware (firmware_iface.virtual.served); without it, the host's USB
serial = "HL0001"             where several are attached
refresh_hz = 60.0             of the panel itself; with fields, of a field: 180 for three on a display of 60 Hz
fields = 3                    not mirrored: patterns in turn, a field each, with lasers gated to them: 3 for three
                              colours, 6 for two patterns of each; without it, one colour and one pattern (version 1 of
                              the board's protocol)
modulator = "p47"             dlpc900: or "p67"
display = 1                   mirrored, and dlpc900 unless frames are uploaded over USB: N of /dev/fbN
height = 1080                 mirrored: its pixels
width = 1920

[lasers]                      three lasers on an I2C bus
bus = "/dev/i2c-1"            or virtual:SOCKET
power = { green = 0.5 }       fraction of full while something is shown; other lasers stay dark
mrad_per_pixel = 0.5          angle of a pixel at the eye: patterns' bright spots are predicted and budgeted;
                              without it, all light is taken to be one spot
[[lasers.channel]]            calibration of each, in the order of the DAC's outputs, none left out; virtual: may be
                              left out as a whole
name = "green"
wavelength_nm = 520.0
full_power_uw = 100.0
threshold_ma = 40.0
slope_uw_per_ma = 4.0

[camera]
kind = "oak"                  the Luxonis OAK line; "virtual" with bus: emulated hardware without the camera's link;
                              or "MODULE:FUNCTION"
address = "10.0.0.5"          its IP address, MX ID or USB path; without it, the first that is found
exposure_ms = 10.0
frames_per_s = 60.0
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from firmware_iface.errors import InputError, nearest
from firmware_iface.lasers import VIRTUAL_CHANNELS, LaserChannel
from firmware_iface.lasers.eye_safety import GatedLight, exposure
from firmware_iface.own_device import check_kind, open_own
from firmware_iface.panel.fields import FieldPanel, light_times_us
from firmware_iface.toml_tables import parameter, read_table

Table = Mapping[str, Any]

MOST_LASERS = 3  # of a board: no more colours are shown in turn
KINDS = {"panel": ("board", "dlpc900", "mirrored"), "camera": ("oak", "virtual")}


@dataclass(frozen=True)
class PanelTable:
    """Keys of [panel]."""

    kind: str = parameter("board", "which panel")
    bus: str = parameter("usb", "usb, or virtual:SOCKET")
    serial: str = parameter("", "serial number, where several are attached")
    refresh_hz: float = parameter(60.0, "of the panel", 10, 1000)
    fields: int = parameter(1, "of a frame: colours in turn, each as often as it has patterns", 1, 24)
    timeout_ms: float = parameter(80.0, "longest wait for one transfer", 5, 10000)
    modulator: str = parameter("p47", "of a DLPC900", choices=("p47", "p67"))
    display: int = parameter(-1, "N of /dev/fbN; -1: none", -1, 63)
    height: int = parameter(1080, "rows of a mirrored panel", 2, 8192)
    width: int = parameter(1920, "columns of a mirrored panel", 2, 8192)


@dataclass(frozen=True)
class LasersTable:
    """Keys of [lasers] except power and channel."""

    bus: str = parameter(about="/dev/i2c-N, or virtual:SOCKET")
    mrad_per_pixel: float = parameter(
        0.0, "angle of a panel pixel's image at the eye; 0: one spot is assumed", 0, 100
    )


@dataclass(frozen=True)
class CameraTable:
    """Keys of [camera]."""

    kind: str = parameter("oak", "which camera")
    bus: str = parameter("", "virtual:SOCKET")
    address: str = parameter("", "IP address, MX ID or USB path")
    exposure_ms: float = parameter(10.0, "exposure time", 0.001, 10000)
    frames_per_s: float = parameter(60.0, "pictures a second", 1, 1000)


def open_panel(table: Table, gated: GatedLight | None = None) -> Any:
    """The panel of a configuration's [panel]; where it shows fields, it refuses frames with more light than `gated`.

    Raises
    ------
    InputError
        Where the table is wrong.
    DeviceError
        Where the panel cannot be opened.
    """
    from firmware_iface.panel import open_board, open_dlpc900, open_mirrored
    from firmware_iface.panel.panel_board_messages import Timing
    from firmware_iface.panel.phase_light_modulator import P47, P67

    settings = _panel_table(table)
    period_us = round(1e6 / settings.refresh_hz)
    if settings.kind not in KINDS["panel"]:
        return _budgeted(_with_fields(open_own(settings.kind, "panel"), settings, period_us), gated)
    if settings.kind == "mirrored":
        return open_mirrored(max(0, settings.display), (settings.height, settings.width))
    if settings.kind == "dlpc900":
        return _budgeted(
            open_dlpc900(
                None if settings.display < 0 else settings.display,
                modulator={"p47": P47, "p67": P67}[settings.modulator],
                serial=settings.serial or None,
                timeout_s=settings.timeout_ms / 1000,
                exposure_us=period_us if settings.fields > 1 else 16000,
                fields=settings.fields,
            ),
            gated,
        )
    timing = Timing(period_us, light_delay_us=period_us // 4, light_width_us=period_us // 2)
    backend = None
    if settings.bus.startswith("virtual:"):
        from firmware_iface.virtual.remote_hardware import usb_backend

        backend = usb_backend(settings.bus)
    return _budgeted(
        open_board(
            settings.serial or None,
            backend=backend,
            timing=timing,
            timeout_s=settings.timeout_ms / 1000,
            fields=settings.fields,
        ),
        gated,
    )


def _with_fields(panel: Any, settings: PanelTable, field_us: int) -> Any:
    """A panel of the lab's own, if it shows frames of as many fields as [panel] says, each as long as it says."""
    if settings.fields == 1:
        return panel
    if isinstance(panel, FieldPanel):
        if (panel.fields, panel.field_us) == (settings.fields, field_us):
            return panel
        found = f"{panel.fields} of {panel.field_us} µs"
    else:
        found = "one"
    panel.close()
    raise InputError(
        f"[panel] has {settings.fields} fields of {field_us} µs, and what '{settings.kind}' opens shows {found}; "
        "give that function's result as many, or change fields and refresh_hz"
    )


def _budgeted(panel: Any, gated: GatedLight | None) -> Any:
    """The panel, which shows no more light than the lasers are budgeted for, where that is known."""
    if isinstance(panel, FieldPanel) and gated is not None:
        panel.gated = gated
    return panel


def panel_fields(table: Table) -> int:
    """How many fields a frame has on the panel of a configuration's [panel]; 1: one pattern, which is not gated."""
    return _panel_table(table).fields


def frame_s(table: Table) -> float:
    """Time of a frame with all of its fields on the panel of a configuration's [panel], s."""
    settings = _panel_table(table)
    return settings.fields * round(1e6 / settings.refresh_hz) * 1e-6


def gated_light(table: Table, pulses: int) -> GatedLight | None:
    """How the panel of a configuration's [panel] gates the lasers, at most; None where it does not.

    Parameters
    ----------
    table : mapping
        [panel].
    pulses : int
        In how many fields of a frame one laser may shine: the patterns of its colour.
    """
    settings = _panel_table(table)
    if settings.fields == 1:
        return None
    field_us = round(1e6 / settings.refresh_hz)
    _, light_us = light_times_us(field_us)
    frame_us = settings.fields * field_us
    return GatedLight(pulses * light_us / frame_us, 1e-6 * light_us, 1e-6 * frame_us, pulses)


def open_lasers(table: Table, gated: GatedLight | None = None) -> Any:
    """The lasers of a configuration's [lasers], dark; gated as `gated_light` says.

    Raises
    ------
    InputError
        Where the table is wrong.
    DeviceError
        Where the board cannot be opened.
    """
    from firmware_iface.lasers import open_lasers as open_board
    from firmware_iface.virtual.remote_hardware import i2c_bus

    settings = _lasers_table(table)
    bus = i2c_bus(settings.bus) if settings.bus.startswith("virtual:") else settings.bus
    return open_board(bus, laser_channels(table), gated)


def open_camera(table: Table, timeout_s: float = 1.0) -> Any:
    """The camera of a configuration's [camera]; an OAK that gives no picture for `timeout_s` is an error.

    Raises
    ------
    InputError
        Where the table is wrong.
    DeviceError
        Where the camera cannot be opened.
    """
    settings = _camera_table(table)
    if settings.kind not in KINDS["camera"]:
        return open_own(settings.kind, "camera", exposure_ms=settings.exposure_ms)
    if settings.kind == "oak":
        from firmware_iface.camera import open_oak

        return open_oak(
            settings.address,
            frames_per_s=settings.frames_per_s,
            exposure_ms=settings.exposure_ms,
            timeout_s=timeout_s,
            starved_s=0.5,
        )
    from firmware_iface.virtual.remote_hardware import RemoteCamera, reach

    camera = RemoteCamera(reach(settings.bus))
    camera.exposure_ms = settings.exposure_ms
    return camera


def simulated(tables: Mapping[str, Any]) -> bool:
    """Whether a device of [panel], [lasers] and [camera] is emulated, so that what is captured is simulated."""
    found = (tables[name] for name in ("panel", "lasers", "camera") if name in tables)
    return any(one.get("kind") == "virtual" or str(one.get("bus")).startswith("virtual:") for one in found)


def check_tables(tables: Mapping[str, Table]) -> None:
    """Check [panel], [lasers] and [camera] without opening anything.

    How many colours are shown is not known here, so the power is checked for as many as can be, which are lit least
    often; `check_budget` checks it for the true number.

    Raises
    ------
    InputError
        Where a table is wrong, or the power exceeds the Class 1 budget.
    """
    if "panel" in tables:
        _panel_table(tables["panel"])
    if "camera" in tables:
        _camera_table(tables["camera"])
    _lasers_table(tables["lasers"])
    fewest = math.ceil(panel_fields(tables["panel"]) / MOST_LASERS) if "panel" in tables else 1
    check_budget(tables, fewest)


def _panel_table(table: Table) -> PanelTable:
    settings = read_table(PanelTable, table, "[panel]")
    check_kind(settings.kind, "panel", KINDS["panel"])
    if settings.fields > 1 and settings.kind == "mirrored":
        raise InputError(
            "a panel of kind 'mirrored' in [panel] shows one colour; leave fields out, or use board or dlpc900"
        )
    return settings


def _lasers_table(table: Table) -> LasersTable:
    return read_table(LasersTable, table, "[lasers]", ignore=("power", "channel"))


def _camera_table(table: Table) -> CameraTable:
    settings = read_table(CameraTable, table, "[camera]")
    check_kind(settings.kind, "camera", KINDS["camera"])
    return settings


def check_budget(tables: Mapping[str, Table], pulses: int) -> None:
    """Check the power of [lasers], summed over the fields of a frame: without a prediction, all light is one spot.

    Parameters
    ----------
    tables : mapping
        With [lasers] and, where there is one, [panel].
    pulses : int
        As in `gated_light`.

    Raises
    ------
    InputError
        Where it exceeds the Class 1 budget.
    """
    table = tables["lasers"]
    gated = gated_light(tables["panel"], pulses) if "panel" in tables else None
    power, lasers = laser_power(table), {laser.name: laser for laser in laser_channels(table)}
    if mrad_per_pixel(table):
        return
    used = exposure(
        {name: fraction * lasers[name].full_power_uw for name, fraction in power.items()},
        {name: lasers[name].wavelength_nm for name in power},
        gated=gated,
    ).worst
    if used > 1:
        raise InputError(
            f"power in [lasers] is {used:.2f} of the Class 1 budget of one spot{_how(gated)}; lower it, or write "
            "mrad_per_pixel, so that the light of each pattern is predicted"
        )


def _how(gated: GatedLight | None) -> str:
    return "" if gated is None else f", with each laser in {gated.pulses} of a frame's fields"


def mrad_per_pixel(table: Table) -> float:
    """The angle of a pixel at the eye, mrad, for the prediction of bright spots; 0: no prediction."""
    return _lasers_table(table).mrad_per_pixel


def laser_channels(table: Table) -> Sequence[LaserChannel]:
    """The lasers of [[lasers.channel]]; on an emulated board, where there are none, its own.

    Raises
    ------
    InputError
        Where there is none, two have one name, or a value is out of range.
    """
    given = table.get("channel", [])
    if not given and str(table.get("bus")).startswith("virtual:"):
        return VIRTUAL_CHANNELS
    if not isinstance(given, list) or not given:
        raise InputError("[lasers] describes no laser: write [[lasers.channel]] for each")
    lasers = [read_table(LaserChannel, one, f"[[lasers.channel]] {k}") for k, one in enumerate(given)]
    names = [laser.name for laser in lasers]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise InputError(
                f"[[lasers.channel]] {names.index(name)} and {k} are both name = {name!r}: give each its own name, or "
                "remove one"
            )
    return lasers


def laser_numbers(table: Table, channels: Sequence[str]) -> list[int]:
    """The laser of each channel, counted from 0 in the order of the DAC's outputs.

    Raises
    ------
    InputError
        Where a channel has none.
    """
    names = [laser.name for laser in laser_channels(table)]
    for channel in channels:
        if channel not in names:
            raise InputError(f"[lasers] has no laser '{channel}'; {nearest(channel, names)}")
    return [names.index(channel) for channel in channels]


def laser_power(table: Table) -> dict[str, float]:
    """The power of each channel while something is shown, fraction of full.

    Raises
    ------
    InputError
        Where none is given, a channel is unknown or a value is no fraction.
    """
    power = table.get("power")
    if not isinstance(power, Mapping) or not power:
        raise InputError(
            "[lasers] names no power: write power = { green = 0.5 }, a fraction for each channel"
        )
    for channel, fraction in power.items():
        if isinstance(fraction, bool) or not isinstance(fraction, int | float) or not 0 <= fraction <= 1:
            raise InputError(f"the power of '{channel}' in [lasers] is {fraction!r}; give a fraction, 0 to 1")
    names = [channel.name for channel in laser_channels(table)]
    for channel in power:
        if channel not in names:
            raise InputError(
                f"there is no laser '{channel}' for power in [lasers]; {nearest(channel, names)}"
            )
    return {channel: float(fraction) for channel, fraction in power.items()}
