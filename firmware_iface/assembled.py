"""The devices that a configuration names, opened: one table each, one function each.

[panel]                      [lasers]                          [camera]
kind = "virtual"             kind = "virtual"                  kind = "virtual"
bench = "virtual:demo"       bench = "virtual:demo"            bench = "virtual:demo"
                             power = { green = 0.5 }
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .errors import InputError, nearest

Table = Mapping[str, Any]


def open_panel(table: Table) -> Any:
    """The panel of a configuration's [panel]. Raises InputError or DeviceError."""
    return _opened("panel", PANELS, table)


def open_lasers(table: Table) -> Any:
    """The lasers of a configuration's [lasers], dark. Raises InputError or DeviceError."""
    return _opened("lasers", LASERS, table)


def open_camera(table: Table) -> Any:
    """The camera of a configuration's [camera]. Raises InputError or DeviceError."""
    return _opened("camera", CAMERAS, table)


def laser_power(table: Table) -> dict[str, float]:
    """The power of each channel while something is shown, fraction of full. Raises InputError."""
    power = table.get("power")
    if not isinstance(power, Mapping) or not power:
        raise InputError(
            "[lasers] names no power: write power = { green = 0.5 }, a fraction for each channel"
        )
    for channel, fraction in power.items():
        if isinstance(fraction, bool) or not isinstance(fraction, int | float) or not 0 <= fraction <= 1:
            raise InputError(f"the power of '{channel}' in [lasers] is {fraction!r}; give a fraction, 0 to 1")
    return {channel: float(fraction) for channel, fraction in power.items()}


def _opened(part: str, kinds: Mapping[str, Any], table: Table) -> Any:
    kind = str(table.get("kind", ""))
    if kind not in kinds:
        raise InputError(f"[{part}] has kind '{kind}'; {nearest(kind, kinds)}")
    return kinds[kind](table)


def _virtual(part: str) -> Any:
    def opened(table: Table) -> Any:
        from .virtual.headset import open_headset

        device = getattr(open_headset(table.get("bench", "virtual:demo")), part)
        device.status = lambda: {}
        device.close = lambda: None
        if part == "lasers":
            st = [0]
            device.latch = lambda: st.__setitem__(0, 3)
            device.disarm = lambda: st.__setitem__(0, 0)
            device.clear = lambda: st.__setitem__(0, 0)
            device.arm = lambda: st.__setitem__(0, 1)
            device.beat = lambda: None
            device.state = lambda: (st[0], 0)
        return device

    return opened


PANELS = {"virtual": _virtual("panel")}
LASERS = {"virtual": _virtual("lasers")}
CAMERAS = {"virtual": _virtual("camera")}
