"""`hololoop-runtime show`: patterns on a headset's panel, lit, and what its camera sees."""

from __future__ import annotations

import time
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from firmware_iface.errors import InputError
from runtime.bundle.whole_files import whole_file
from runtime.headset.open_devices import emulated, open_devices

ABOUT = """Show patterns on a headset, one after the other, and save what its camera sees of each.

PATTERN is an 8-bit gray PNG of the panel's size, as `solve` writes it. Lasers are lit while patterns are shown and
dark afterwards, whatever happens. Pictures are 16-bit gray PNGs of the camera's counts: NAME-seen.png.

With --emulated, the headset of a virtual bench is emulated down to the bytes of its buses and driven through the real
pyusb, smbus2 and depthai libraries, as real hardware would be.

examples:
  hololoop-runtime show pattern.png --headset headset.toml --out seen/
  hololoop-runtime show pattern.png --headset virtual:demo --emulated"""


def arguments(parser: ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("patterns", metavar="PATTERN", type=Path, nargs="+", help="8-bit gray PNGs")
    parser.add_argument(
        "--headset",
        metavar="SPEC",
        required=True,
        help="a service's configuration, virtual:NAME, or a virtual bench's TOML file",
    )
    parser.add_argument("--emulated", action="store_true", help="emulate the virtual bench's buses as well")
    parser.add_argument("--channel", metavar="C", help="the laser to light (default: the headset's first)")
    parser.add_argument(
        "--exposure-ms", metavar="T", type=_positive, help="of the camera (default: as it is)"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for what the camera sees")


def run(args: Namespace) -> dict[str, Any]:
    """Show and capture; returns what `--json` prints. Raises InputError, and DeviceError where a device fails."""
    grays = [read_pattern(path) for path in args.patterns]
    with ExitStack() as stack:
        opened = emulated(args.headset) if args.emulated else open_devices(args.headset)
        devices = stack.enter_context(opened)
        channel = _channel(args.channel, devices)
        if args.exposure_ms is not None:
            devices.camera.exposure_ms = args.exposure_ms
        devices.light(channel)
        top = 2**devices.camera.bit_depth - 1
        shown = []
        for path, gray in zip(args.patterns, grays, strict=True):
            begin = time.perf_counter()
            devices.panel.show(gray)
            took_ms = 1000 * (time.perf_counter() - begin)
            counts = devices.camera.capture()
            shown.append(
                {
                    "pattern": str(path),
                    "show_ms": round(took_ms, 3),
                    "seen": None if args.out is None else str(_save(counts, args.out, path)),
                    "mean_counts": round(float(counts.mean()), 2),
                    "brightest_counts": int(counts.max()),
                    "saturated_share": float((counts >= top).mean()),
                }
            )
        exposure_ms = devices.camera.exposure_ms
    return {"headset": args.headset, "channel": channel, "exposure_ms": exposure_ms, "shown": shown}


def show(result: dict[str, Any]) -> None:
    """What was seen, a line a pattern."""
    print(f"{result['headset']}, {result['channel']}, {result['exposure_ms']:g} ms")
    for one in result["shown"]:
        saturated = f", {100 * one['saturated_share']:.2g} % saturated" if one["saturated_share"] else ""
        where = f" -> {one['seen']}" if one["seen"] else ""
        print(
            f"{one['pattern']}: shown in {one['show_ms']:.1f} ms; {one['mean_counts']:.1f} counts in the mean, "
            f"{one['brightest_counts']} at most{saturated}{where}"
        )


def read_pattern(path: Path) -> np.ndarray:
    """Gray levels, uint8 [H, W], of an 8-bit gray PNG. Raises InputError."""
    try:
        with Image.open(path) as image:
            image.load()
            if image.mode != "L":
                raise InputError(
                    f"{path} is not 8-bit gray ({image.mode}): give a pattern as `solve` writes it"
                )
            return np.array(image, np.uint8)
    except FileNotFoundError:
        raise InputError(f"{path} is missing: give a pattern as `solve` writes it") from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} is not a picture ({error}): give a pattern as `solve` writes it") from None


def _channel(asked: str | None, devices: Any) -> str:
    known = [c for c in devices.lasers.channels if not devices.power or c in devices.power]
    if asked is not None and asked not in devices.lasers.channels:
        raise InputError(f"there is no laser '{asked}'; use one of {', '.join(devices.lasers.channels)}")
    return asked or known[0]


def _save(counts: np.ndarray, folder: Path, pattern: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{pattern.stem}-seen.png"
    with whole_file(path) as file:
        Image.fromarray(counts).save(file, "PNG")
    return path


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value <= 10000:
        raise ArgumentTypeError(f"{text!r} is not an exposure in ms: give more than 0 and at most 10000")
    return value
