"""What is attached to a host or named in a headset's configuration, what answers, what is wrong, and what to do."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from firmware_iface.configured_devices import (
    laser_power,
    open_camera,
    open_lasers,
    open_panel,
    panel_fields,
)
from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.laser_board_findings import laser_problems
from runtime.bundle.bundle_folder import read_bundle
from runtime.bundle.light_path_arrays import bundle_channels
from runtime.service.configuration import Configuration

KNOWN_USB = {
    (0x1209, 0x0001): "panel board",
    (0x0451, 0xC900): "DLPC900 phase light modulator",
    (0x03E7, 0x2485): "OAK camera, not booted",
    (0x03E7, 0xF63B): "OAK camera, booted",
}
SATURATED, TOO_MANY = 0.99, 0.02  # of full scale; of the pixels
NEEDED = {  # what the safety controller needs to hold before anything can be armed, without this program's own share
    "key": "the key is off: turn it on",
    "interlock": "the interlock is open: close it",
    "dark": "the DAC is not dark: switch the laser board off and on",
    "cool": "the lasers are too hot: let them cool down",
    "quiet": "a photodiode sees too much light: find its source",
    "ceilings": "the ceilings are not written: switch the laser board off and on",
}


@dataclass
class Finding:
    """One device, and how it is.

    Attributes
    ----------
    part : str
        panel, lasers, camera, bundle, service, usb or i2c.
    what : str
        Which one it is, in words.
    attached, answers : bool
        Whether it is there, and whether it answers.
    status : dict
        What it says of itself.
    problems : list of str
        Each a sentence with what to do.
    """

    part: str
    what: str
    attached: bool = True
    answers: bool = True
    status: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


def host_findings() -> list[Finding]:
    """What this host has, without opening any of it."""
    return [*_usb(), *_i2c(), _camera_library()]


def headset_findings(configuration: Configuration) -> list[Finding]:
    """The devices of a configuration, or its service where that runs."""
    if (service := _service(configuration)) is not None:
        return [service]
    bundle, shape = _bundle(configuration)
    lasers = _lasers(configuration.devices["lasers"])
    lasers.problems += _unlit(configuration)
    found = [bundle, _panel(configuration.devices["panel"], shape), lasers]
    if "camera" in configuration.devices:
        found.append(_camera(configuration.devices["camera"]))
    return found


def _usb() -> list[Finding]:
    import usb.core

    try:
        devices = list(usb.core.find(find_all=True) or [])
    except usb.core.NoBackendError:
        problem = "libusb is not installed, so no USB device can be opened: install libusb-1.0"
        return [Finding("usb", "the host's USB", answers=False, problems=[problem])]
    except usb.core.USBError as error:
        problem = f"USB cannot be looked at ({error.strerror}): check /dev/bus/usb and its rights"
        return [Finding("usb", "the host's USB", answers=False, problems=[problem])]
    known = [(KNOWN_USB.get((d.idVendor, d.idProduct)), d) for d in devices]
    found = [
        Finding("usb", f"{name}, {d.idVendor:04x}:{d.idProduct:04x}, bus {d.bus} address {d.address}")
        for name, d in known
        if name
    ]
    nothing = f"{len(devices)} devices, none that hololoop knows"
    return found or [Finding("usb", nothing, attached=False, answers=False)]


def _i2c() -> list[Finding]:
    buses = sorted(Path("/dev").glob("i2c-*"))
    if not buses:
        problem = "there is no /dev/i2c-*: load the module i2c-dev, and enable the host's I2C"
        return [Finding("i2c", "the host's I2C", attached=False, answers=False, problems=[problem])]
    found = []
    for bus in buses:
        allowed = os.access(bus, os.R_OK | os.W_OK)
        problems = [] if allowed else [f"this user may not open {bus}: add it to the group i2c"]
        found.append(Finding("i2c", str(bus), answers=allowed, problems=problems))
    return found


def _camera_library() -> Finding:
    there = importlib.util.find_spec("depthai") is not None
    problems = [] if there else ["depthai is not installed: pip install 'hololoop[camera]' for an OAK camera"]
    return Finding("camera", "depthai, the library of OAK cameras", there, there, problems=problems)


def _service(configuration: Configuration) -> Finding | None:
    from runtime.service.client import connect
    from runtime.service.protocol import LaserState, PartState

    try:
        with connect(configuration.socket, timeout_s=2.0) as client:
            state = client.status()
    except (InputError, OSError):
        return None
    parts = {
        "panel": PartState(state.panel),
        "solver": PartState(state.solver),
        "camera": PartState(state.camera),
    }
    problems = [
        f"the service has no sign of life of the {name} ({part.name.lower()}): its log says why"
        for name, part in parts.items()
        if part not in (PartState.FRESH, PartState.ABSENT)
    ]
    if state.lasers in (LaserState.FAULT, LaserState.LOST):
        problems.append(
            f"lasers: {LaserState(state.lasers).name.lower()}; find the cause in the log, clear and arm"
        )
    status: dict[str, Any] = {name: part.name.lower() for name, part in parts.items()}
    status |= {"lasers": LaserState(state.lasers).name.lower(), "shown": state.shown, "late": state.late}
    status |= {"failed": state.failed, "faults": state.faults}
    return Finding("service", f"the service at {configuration.socket}", status=status, problems=problems)


def _bundle(configuration: Configuration) -> tuple[Finding, tuple[int, ...] | None]:
    from runtime.service.frame_solver import open_solver

    found = Finding("bundle", str(configuration.bundle))
    try:
        shape = open_solver(configuration).shape[1:]
    except InputError as error:
        found.attached, found.answers = configuration.bundle.is_dir(), False
        found.problems.append(str(error))
        return found, None
    found.status["shape"] = list(shape)
    return found, shape


def _opened(found: Finding, opening: Callable[[], Any], look: Callable[[Any], None]) -> Finding:
    """Open a device and look at it; what it raises is a problem."""
    try:
        with closing(opening()) as device:
            found.status |= device.status()
            look(device)
    except (DeviceError, InputError, OSError) as error:
        found.answers = False
        found.attached = not isinstance(error, DeviceGoneError)
        found.problems.append(str(error))
    return found


def _place(table: dict[str, Any], usual: str, where: str) -> str:
    """What a device is and where; a lab's own device (MODULE:FUNCTION) knows its place itself."""
    kind = str(table.get("kind", usual))
    return kind if ":" in kind else f"{kind} at {where}"


def _panel(table: dict[str, Any], shape: tuple[int, ...] | None) -> Finding:
    found = Finding("panel", _place(table, "board", table.get("bus", "usb")))

    def look(panel: Any) -> None:
        found.problems += [
            f"the panel reports: {fault}; check it" for fault in found.status.get("faults", [])
        ]
        if shape is not None and tuple(panel.shape) != tuple(shape):
            found.problems.append(
                f"the panel is {panel.shape} and the bundle is for {shape}: export its own bundle"
            )

    return _opened(found, lambda: open_panel(table), look)


def _lasers(table: dict[str, Any]) -> Finding:
    found = Finding("lasers", f"laser board at {table.get('bus')}")

    def look(lasers: Any) -> None:
        holds = found.status["holds"]
        found.problems += [problem for name, problem in NEEDED.items() if not holds.get(name, True)]
        if found.status["faults"]:
            latched = ", ".join(found.status["faults"])
            found.problems.append(
                f"latched: {latched}; find the cause, then clear and arm through the service"
            )

        found.problems += laser_problems(table)

    return _opened(found, lambda: open_lasers(table), look)


def _unlit(configuration: Configuration) -> list[str]:
    """What is wrong where the colour that the service shows gets no light."""
    try:
        channels = bundle_channels(read_bundle(configuration.bundle))
    except InputError:  # reported of the bundle
        return []
    chosen = configuration.timing.channel
    several = not chosen and panel_fields(configuration.devices["panel"]) > 1
    power = laser_power(configuration.devices["lasers"])
    return [
        f"the service shows {shown} and its laser gets no power: write power = {{ {shown} = 0.5 }} in [lasers]"
        for shown in (channels if several else [chosen or channels[0]])
        if shown in channels and not power.get(shown, 0.0) > 0
    ]


def _camera(table: dict[str, Any]) -> Finding:
    found = Finding("camera", _place(table, "oak", table.get("address") or table.get("bus", "")))

    def look(camera: Any) -> None:
        counts = camera.capture()
        full = 2**camera.bit_depth - 1
        found.status |= {"shape": list(counts.shape), "mean_counts": round(float(counts.mean()), 1)}
        share = float((counts >= SATURATED * full).mean())
        if share > TOO_MANY:
            found.problems.append(
                f"{100 * share:.0f} % of the pixels are saturated with the lasers dark: shade it, or expose less"
            )

    return _opened(found, lambda: open_camera(table), look)
