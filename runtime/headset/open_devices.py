"""Open the devices of a headset, real or virtual, by one name: for captures, calibration and refinement."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from firmware_iface.errors import InputError
from runtime.headset.followed_camera import FollowedCamera

FULL = 1.0  # power where none is given: the most that the safety controller allows
FRAMES_HZ = 60.0  # of an emulated panel
PICTURES_HZ = 4.0  # of an emulated camera, which so may expose for 15 frames
SIMULATED_S = 60.0  # a simulated picture, which no camera waits for, may take as long as its optics compute


@dataclass(frozen=True)
class Devices:
    """Panel, lasers and camera of a headset.

    Attributes
    ----------
    panel, lasers, camera
        The opened devices.
    power : mapping of str to float
        Fraction of full power of each colour while it is lit; FULL where it is not named.
    focus : callable or None
        Focuses the camera on a plane, mm from the panel; None: the focus is fixed.
    """

    panel: Any
    lasers: Any
    camera: Any
    power: Mapping[str, float] = field(default_factory=dict)
    focus: Callable[[float], None] | None = None

    def move_to_plane(self, plane_mm: float) -> None:
        """Focus the camera on a plane, mm from the panel, where its focus can move."""
        if self.focus:
            self.focus(plane_mm)

    def light(self, channel: str) -> None:
        """Switch one laser on and all others off."""
        self.light_all([channel])

    def light_all(self, channels: Sequence[str]) -> None:
        """Switch these lasers on and all others off."""
        self.lasers.off()
        for channel in channels:
            self.lasers.set_power(channel, self.power.get(channel, FULL))


@contextmanager
def open_devices(spec: str, seed: int = 0, fields: int = 1, pulses: int = 1) -> Iterator[Devices]:
    """The devices of `virtual:NAME`, of a virtual bench's TOML file, or of a service's configuration; dark at the end.

    With a configuration, the lasers are armed, in a guard process that switches them off when this process ends in any
    way, and a picture that is taken after a fault of the lasers raises DeviceError.

    Parameters
    ----------
    spec : str
        `virtual:NAME`, or the path of a file.
    seed : int
        Of a virtual bench's noise.
    fields : int
        Fields of a frame; more than 1 opens a panel that shows them in turn (`show_fields`) and gates the lasers.
    pulses : int
        In how many of them one laser may shine.

    Yields
    ------
    Devices

    Raises
    ------
    InputError
        Where the devices cannot be opened as they are described.
    DeviceError
        Where a device fails or a fault is latched (which a person has to clear).
    """
    tables = configuration_of(spec)
    if tables is None:
        from firmware_iface.virtual import open_headset

        headset = open_headset(spec, seed)
        yield Devices(headset.panel, headset.lasers, headset.camera, {}, headset.move_to_plane)
        return
    for name in ("panel", "lasers", "camera"):
        if name not in tables:
            raise InputError(f"{spec} has no [{name}]: the panel, the lasers and the camera are all needed")
    with open_tables(tables, fields, pulses) as devices:
        yield devices


@contextmanager
def open_tables(tables: Mapping[str, Any], fields: int = 1, pulses: int = 1) -> Iterator[Devices]:
    """As `open_devices`, for the tables [panel], [lasers] and [camera] of a configuration."""
    from firmware_iface.configured_devices import (
        gated_light,
        laser_channels,
        laser_power,
        open_camera,
        open_panel,
        simulated,
    )
    from firmware_iface.lasers.guarded_lasers import open_guarded_lasers
    from firmware_iface.virtual.remote_hardware import i2c_bus

    bus = str(tables["lasers"].get("bus"))
    panel_table = {**tables["panel"], "fields": fields}
    with ExitStack() as stack:
        patience = {"timeout_s": SIMULATED_S} if simulated(tables) else {}
        camera = stack.enter_context(closing(open_camera(tables["camera"], **patience)))
        gated = gated_light(panel_table, pulses)
        panel = stack.enter_context(closing(open_panel(panel_table, gated)))
        bus = i2c_bus(bus) if bus.startswith("virtual:") else bus
        guarded = open_guarded_lasers(bus, laser_channels(tables["lasers"]), gated)
        lasers = stack.enter_context(closing(guarded))
        lasers.arm()
        stack.enter_context(lasers.beating())
        stack.callback(lasers.off)
        # Of lasers that a fault has put out, nothing can be learned; their guard knows of one within 25 ms.
        lit = FollowedCamera(camera, lambda _: lasers.heartbeat())
        yield Devices(panel, lasers, lit, laser_power(tables["lasers"]))


@contextmanager
def emulated(bench: str, seed: int = 0, fields: int = 1) -> Iterator[Devices]:
    """A virtual bench inside hardware emulated down to the bytes of its buses, driven through a real headset's drivers.

    The camera is an emulated OAK where depthai is installed, and one without a link of its own elsewhere.

    Parameters
    ----------
    bench : str
        `virtual:NAME`, or the path of a virtual bench's TOML file.
    seed : int
        Of the bench's noise.
    fields : int
        As in `open_devices`.

    Yields
    ------
    Devices

    Raises
    ------
    InputError, DeviceError
        As `open_devices`.
    """
    from firmware_iface.virtual import load_bench
    from firmware_iface.virtual.remote_hardware import PREFIX, running

    colours = [c.name for c in load_bench(bench).channels]
    with TemporaryDirectory(prefix="hololoop-") as folder:
        socket = Path(folder) / "hardware.sock"
        bus = f"{PREFIX}{socket}"
        # An address of this run alone: other runs may be active.
        address = f"127.{os.getpid() >> 16 & 255}.{os.getpid() >> 8 & 255}.{os.getpid() % 254 + 1}"
        camera = (
            {"kind": "oak", "address": address, "frames_per_s": PICTURES_HZ}
            if find_spec("depthai")
            else {"kind": "virtual", "bus": bus}
        )
        with running(socket, bench, seed, address):
            lasers = {"bus": bus, "power": dict.fromkeys(colours, FULL)}
            panel = {"bus": bus, "refresh_hz": fields * FRAMES_HZ}
            with open_tables({"panel": panel, "lasers": lasers, "camera": camera}, fields) as devices:
                yield devices


def is_simulated(spec: str) -> bool:
    """Whether `open_devices` opens a simulated bench, or hardware that is emulated.

    Raises
    ------
    InputError
        Where a configuration is wrong.
    """
    from firmware_iface.configured_devices import simulated

    tables = configuration_of(spec)
    return tables is None or simulated(tables)


def configuration_of(spec: str) -> dict[str, Any] | None:
    """The tables of the devices in a service's configuration; None for a virtual bench."""
    if spec.startswith("virtual:") or not Path(spec).is_file():
        return None
    try:
        tables = tomllib.loads(Path(spec).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return None  # opening it as a bench then reports the error
    if "lasers" not in tables:
        return None
    from runtime.service.configuration import read_configuration

    return read_configuration(spec).devices
