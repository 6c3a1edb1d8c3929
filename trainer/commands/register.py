"""`hololoop-trainer register`: where an unregistered camera looks, from a dot pattern."""

from __future__ import annotations

import copy
import tomllib
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from firmware_iface.errors import InputError
from runtime.program.command import Command, Result
from runtime.program.options import millimetres
from runtime.program.outputs import Output, files_written
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.outputs import out_option

if TYPE_CHECKING:
    import numpy as np

SAME_PIXELS = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def options(parser: ArgumentParser) -> None:
    """The options of `register`."""
    parser.add_argument("bench", metavar="BENCH.toml", type=Path, help="the bench file of a capture set")
    parser.add_argument(
        "image", metavar="IMAGE.png", type=Path, nargs="?", help="the camera's picture of the dot pattern"
    )
    parser.add_argument(
        "--spacing", type=float, default=32.0, metavar="PX", help="panel pixels between dots (default 32)"
    )
    parser.add_argument("--channel", metavar="NAME", help="colour to show the dots in (default: the first)")
    parser.add_argument(
        "--plane", type=millimetres, metavar="MM", help="image plane (default: the bench's distance)"
    )
    out_option(parser, "DOTS.png", "where the pattern to show goes", required=False)


def run(args: Namespace, screen: Screen) -> Result:
    """Write the pattern to show, or read its picture and write the homography into bench.toml."""
    from trainer.captures.bench_file import read_bench

    path: Path = args.bench
    tables = _tables(path)
    camera = tables.get("camera")
    if isinstance(camera, dict):
        camera.setdefault("homography", SAME_PIXELS)
        camera["registered"] = False
    bench = read_bench(tables)
    channel = args.channel or bench.channels[0].name
    bench.channel(channel)
    if args.image is None:
        if args.out is None:
            raise InputError(
                "say where the dot pattern goes (--out DOTS.png), or give its picture as IMAGE.png"
            )
        from runtime.solver.pattern_files import write_pattern
        from trainer.captures.patterns import dots_to_show

        write_pattern(args.out, dots_to_show(bench, channel, args.plane or bench.distance_mm, args.spacing))
        return {"pattern": str(args.out), "spacing_px": args.spacing, "channel": channel}
    from runtime.camera.registration import dots_of, find_homography
    from trainer.captures.png_reader import read_picture

    depth = 16 if bench.camera.bit_depth > 8 else 8
    image = read_picture(args.image, bench.camera.shape, depth, f"the dot picture {args.image}")
    found = find_homography(image.astype(float), dots_of(bench.panel.shape, args.spacing))
    _write(path, found)
    return {"homography": found.tolist(), "bench": str(path), "spacing_px": args.spacing, "channel": channel}


def outputs(args: Namespace) -> list[Output]:
    """The pattern to show."""
    return files_written(out=args.out)


def _tables(path: Path) -> dict[str, Any]:
    try:
        return copy.deepcopy(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read ({error}): name the bench.toml of a capture set") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not TOML: {error}") from error


def _write(path: Path, homography: np.ndarray) -> None:
    """Put the homography into the bench file; all else, comments too, stays."""
    import tomlkit

    from runtime.bundle.whole_files import whole_file

    document: Any = tomlkit.parse(path.read_text(encoding="utf-8"))
    document["camera"]["registered"] = False
    document["camera"]["homography"] = [[float(f"{v:.9g}") for v in row] for row in homography]
    with whole_file(path, "w") as stream:
        stream.write(tomlkit.dumps(document))


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What was written, and what comes next."""
    spacing = f"{result['spacing_px']:g}"
    if "pattern" in result:
        screen.say(f"{result['pattern']} shows dots {spacing} panel pixels apart in {result['channel']}.")
        line = command_line("register", args.bench, "picture.png", "--spacing", spacing)
        screen.next(line, "Show it, take a picture that is not saturated, and give that")
    else:
        screen.say(f"{result['bench']} now has the homography from camera pixels to panel pixels.")
        screen.next(command_line("check", args.bench.parent))


COMMAND = Command(
    name="register",
    about="Find where an unregistered camera looks, from a dot pattern.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("register captures/bench.toml --spacing 32 --out dots.png",),
    after="Show dots.png, take a picture of it, and give that: register captures/bench.toml picture.png",
)
