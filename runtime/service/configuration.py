"""The service's configuration: one TOML file with the headset's devices and how the service runs them.

schema = 1
bundle = "bundle"                      # folder of the calibrated light path, from here

[service]
socket = "/run/hololoop/service.sock"  # unless systemd passes one
users = [1000]                         # who may connect, as well as root and the service's own user

[panel]                                # see firmware_iface.configured_devices for the devices' tables
[lasers]
[camera]
"""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_iface.configured_devices import check_tables, gated_light
from firmware_iface.errors import InputError, nearest
from firmware_iface.toml_tables import parameter, read_table

DEVICES = ("panel", "lasers", "camera")


@dataclass(frozen=True)
class Timing:
    """The table [service]: when patterns are shown and for how long, and where the service is reached."""

    refresh_hz: float = parameter(60.0, "pictures a second", 1, 2000)
    solve_ms: float = parameter(12.0, "time for a pattern, ms", 0.1, 60000)
    stale_limit_ms: float = parameter(
        80.0, "a pattern, or a sign of life of panel, solver or camera, older than this is dark", 20, 10000
    )
    metrics_port: int = parameter(0, "of http://127.0.0.1/metrics; 0: none", 0, 65535)
    channel: str = parameter("", "colour to show, where the bundle has several and the panel shows one")
    socket: str = parameter("/run/hololoop/service.sock", "path of the Unix socket")


@dataclass(frozen=True)
class Configuration:
    """A checked configuration.

    Attributes
    ----------
    file : Path
        The configuration's file.
    bundle : Path
        Folder of the bundle.
    timing : Timing
        The table [service].
    users : frozenset of int
        Numbers of the users who may connect.
    devices : dict
        The tables [panel], [lasers] and, where it exists, [camera], as they are written.
    """

    file: Path
    bundle: Path
    timing: Timing
    users: frozenset[int]
    devices: dict[str, dict[str, Any]]

    @property
    def socket(self) -> Path:
        """Path of the Unix socket, from the configuration's folder."""
        return self.file.parent / self.timing.socket


def read_configuration(file: str | os.PathLike[str]) -> Configuration:
    """Read and check a configuration.

    Raises
    ------
    InputError
        Names the key that is wrong and what is allowed.
    """
    path = Path(file).absolute()
    try:
        tables = tomllib.loads(path.read_bytes().decode())
    except FileNotFoundError:
        raise InputError(f"{file} is missing: write a configuration there, or give its path") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is not TOML ({error}): correct that place") from None
    known = ("schema", "bundle", "service", *DEVICES)
    for key in tables:
        if key not in known:
            raise InputError(f"{file} has an unknown table '{key}'; {nearest(key, known)}")
    if tables.get("schema", 1) != 1:
        raise InputError(f"'schema' in {file} is {tables['schema']!r}; this release reads schema = 1")
    bundle = tables.get("bundle")
    if not isinstance(bundle, str):
        raise InputError(f'{file} names no bundle: add bundle = "FOLDER" at its top')
    service = tables.get("service", {})
    timing = read_table(Timing, service, f"[service] of {file}", ignore=("users",))
    if timing.solve_ms > timing.stale_limit_ms:
        raise InputError(
            f"solve_ms = {timing.solve_ms:g} in [service] of {file} is beyond stale_limit_ms = "
            f"{timing.stale_limit_ms:g}, the age from which nothing is lit: lower solve_ms, or raise stale_limit_ms"
        )
    users = service.get("users", [])
    if not isinstance(users, list) or not all(type(u) is int and u >= 0 for u in users):
        raise InputError(f"'users' in [service] of {file} is {users!r}; give a list of user numbers")
    devices = {name: tables[name] for name in DEVICES if name in tables}
    for name, table in devices.items():
        if not isinstance(table, dict):
            raise InputError(f"'{name}' in {file} is not a table; write [{name}]")
    for name in ("panel", "lasers"):
        if name not in devices:
            raise InputError(f"{file} has no [{name}]: add it, the service cannot show anything without")
    check_tables(devices)
    gated = gated_light(devices["panel"], 1)
    if gated is not None and timing.refresh_hz * gated.frame_s > 1.02:
        raise InputError(
            f"refresh_hz = {timing.refresh_hz:g} in [service] of {file} is more pictures than the panel shows, "
            f"{1 / gated.frame_s:.1f} a second: refresh_hz in [panel] is of a field; raise that one, or lower this"
        )
    return Configuration(path, path.parent / bundle, timing, frozenset({0, os.getuid(), *users}), devices)
