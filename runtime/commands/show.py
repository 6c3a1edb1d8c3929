"""`hololoop-runtime show`: patterns on a headset's panel, lit, and what its camera sees."""

from __future__ import annotations

import time
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from firmware_iface.errors import InputError
from runtime.commands.inputs import headset_option
from runtime.program.command import Command, Result
from runtime.program.options import exposure_ms
from runtime.program.outputs import Output
from runtime.program.screen import Screen

if TYPE_CHECKING:
    import numpy as np

    from runtime.headset.open_devices import Devices

DESCRIPTION = """Show patterns on a headset, one after the other, and save what its camera sees of each.

PATTERN is an 8-bit gray PNG of the panel's size, as `solve` writes it. Lasers are lit while patterns are shown and
dark afterwards, whatever happens. Pictures are 16-bit gray PNGs of the camera's counts: NAME-seen.png.

With --in-turn red,green,blue, the patterns are those of pictures in several colours: the first three are shown in turn
as fields of one picture, each lit by its own laser alone, then the next three, and so on. The panel has to show fields
(a panel board of protocol version 2, or a DLPC900). Each colour is lit for as long as its pattern needs, which `solve`
writes into its PNGs; other files are lit alike. The camera sees the sum: give it an exposure of whole frames. What it
sees is saved under the name of the first of the patterns.

With --emulated, the headset of a virtual bench is emulated down to the bytes of its buses and driven through the real
pyusb, smbus2 and depthai libraries, as real hardware would be."""


def options(parser: ArgumentParser) -> None:
    """The options of `show`."""
    parser.add_argument("patterns", metavar="PATTERN", type=Path, nargs="+", help="8-bit gray PNGs")
    headset_option(parser, required=True)
    parser.add_argument("--emulated", action="store_true", help="emulate the virtual bench's buses as well")
    lit = parser.add_mutually_exclusive_group()
    lit.add_argument("--channel", metavar="C", help="the laser to light (default: the headset's first)")
    lit.add_argument(
        "--in-turn", metavar="C,C,C", type=_names, help="show colours in turn, each lit by its own laser"
    )
    parser.add_argument(
        "--exposure-ms", metavar="T", type=exposure_ms, help="of the camera (default: as it is)"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for what the camera sees")


def run(args: Namespace, screen: Screen) -> Result:
    """Show and capture.

    Raises
    ------
    InputError
        Where a pattern or the headset cannot be used.
    DeviceError
        Where a device fails.
    """
    from runtime.headset.open_devices import emulated, is_simulated, open_devices
    from runtime.solver.pattern_files import read_pattern

    pictures = _pictures(args)
    grays = {path: read_pattern(path) for path in args.patterns}
    fields = len(args.in_turn or [None])
    with ExitStack() as stack:
        opening = emulated if args.emulated else open_devices
        devices = stack.enter_context(opening(args.headset, fields=fields))
        channels = [_laser(name, devices) for name in args.in_turn or [args.channel]]
        if args.exposure_ms is not None:
            devices.camera.exposure_ms = args.exposure_ms
        if not args.in_turn:
            devices.light_all(channels)
        top = 2**devices.camera.bit_depth - 1
        shown: list[dict[str, Any]] = []
        for paths in pictures:
            begin = time.perf_counter()
            _show([grays[path] for path in paths], channels, _times(paths), devices)
            took_ms = 1000 * (time.perf_counter() - begin)
            if args.in_turn and not shown:  # where no field is shown yet, no laser may shine
                devices.light_all(channels)
            counts = devices.camera.capture()
            path = paths[0]
            shown.append(
                {
                    "pattern": str(path),
                    **({"fields": dict(zip(channels, map(str, paths), strict=True))} if args.in_turn else {}),
                    "show_ms": round(took_ms, 3),
                    "seen": None if args.out is None else str(_write_counts(counts, args.out, path)),
                    "mean_counts": round(float(counts.mean()), 2),
                    "brightest_counts": int(counts.max()),
                    "saturated_share": float((counts >= top).mean()),
                }
            )
        exposure = devices.camera.exposure_ms
    return {
        "headset": args.headset,
        "simulated": args.emulated or is_simulated(args.headset),
        "channel": ",".join(channels),
        "exposure_ms": exposure,
        "shown": shown,
    }


def outputs(args: Namespace) -> list[Output]:
    """What the camera sees of each pattern."""
    if args.out is None:
        return []
    return [Output(_seen_file(args.out, paths[0]), makes_folders=True) for paths in _pictures(args)]


def _names(text: str) -> list[str]:
    """Two names or more, with commas."""
    names = [name.strip() for name in text.split(",")]
    if len(names) < 2 or not all(names) or len(set(names)) < len(names):
        raise ArgumentTypeError(f"'{text}' is not several colours: give their names, as red,green,blue")
    return names


def _pictures(args: Namespace) -> list[list[Path]]:
    """The patterns of each picture: one, or one a colour."""
    each = len(args.in_turn or [None])
    if len(args.patterns) % each:
        raise InputError(
            f"--in-turn {','.join(args.in_turn)} needs {each} patterns a picture, and {len(args.patterns)} are given"
        )
    return [args.patterns[k : k + each] for k in range(0, len(args.patterns), each)]


def _times(paths: list[Path]) -> list[float]:
    """Of the light of each colour: what it needs for its balance, or all alike where a file does not say that."""
    from runtime.solver.pattern_files import read_given

    given = [one for one in map(read_given, paths) if one is not None]
    return [min(given) / one for one in given] if len(given) == len(paths) else [1.0] * len(paths)


def _show(grays: list[np.ndarray], channels: list[str], times: list[float], devices: Devices) -> None:
    """Show one pattern, or one for each channel in turn, each lit for a share of its field's light."""
    import numpy as np

    from firmware_iface.panel.fields import colours_in_turn

    if len(grays) == 1:
        devices.panel.show(grays[0])
        return
    if len({gray.shape for gray in grays}) > 1:
        raise InputError("the patterns of a picture have different sizes; give those of one picture together")
    lasers = [devices.lasers.channels.index(channel) for channel in channels]
    frame = colours_in_turn(np.stack(grays), lasers, times, devices.panel.field_us)
    devices.panel.show_fields(frame)


def _seen_file(folder: Path, pattern: Path) -> Path:
    return folder / f"{pattern.stem}-seen.png"


def _laser(asked: str | None, devices: Devices) -> str:
    """The laser to light: the one that is asked for, or the first that has a power."""
    known = [c for c in devices.lasers.channels if not devices.power or c in devices.power]
    if asked is not None and asked not in devices.lasers.channels:
        raise InputError(f"there is no laser '{asked}'; use one of {', '.join(devices.lasers.channels)}")
    return asked or known[0]


def _write_counts(counts: np.ndarray, folder: Path, pattern: Path) -> Path:
    """Write what the camera saw of a pattern, uint16 [H, W]; returns the file."""
    from PIL import Image

    from runtime.bundle.whole_files import whole_file

    folder.mkdir(parents=True, exist_ok=True)
    path = _seen_file(folder, pattern)
    with whole_file(path) as file:
        Image.fromarray(counts).save(file, "PNG")
    return path


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What was seen, a line a pattern."""
    simulated = " (simulated)" if result["simulated"] else ""
    screen.say(f"{result['headset']}{simulated}, {result['channel']}, {result['exposure_ms']:g} ms")
    for one in result["shown"]:
        saturated = f", {100 * one['saturated_share']:.2g} % saturated" if one["saturated_share"] else ""
        where = f" -> {one['seen']}" if one["seen"] else ""
        screen.say(
            f"{one['pattern']}: shown in {one['show_ms']:.1f} ms; {one['mean_counts']:.1f} counts in the mean, "
            f"{one['brightest_counts']} at most{saturated}{where}"
        )


COMMAND = Command(
    name="show",
    about="Show patterns on a headset and save what its camera sees.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=(
        "show pattern.png --headset headset.toml --out seen/",
        "show pattern.png --headset virtual:demo --emulated",
        "show p-red.png p-green.png p-blue.png --in-turn red,green,blue --headset virtual:colour",
    ),
    after="Correct what has drifted: calibrate bundle/ --headset headset.toml --report calibration.html",
    description=DESCRIPTION,
)
