"""`hololoop-runtime refine`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError

ABOUT = """Show a picture, look at it with the headset's camera, and make it better while it is displayed.

Each capture moves the pattern, and draws the bundle's approximator towards what the camera saw. Every third one is held
out; where those are predicted worse than before, the refinement stops and goes back to the best. The bundle is not
changed. The laser is switched on before and off after, and is not touched in between. For bundles of one colour that
were exported with a network, and whose camera a calibration has seen.

examples:
  hololoop-runtime refine bundle/ picture.png --headset headset.toml --out pattern.png --log drift.jsonl"""


def arguments(parser: ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help="folder that hololoop-trainer exported")
    parser.add_argument("target", metavar="TARGET", type=Path, help="picture to show, of any size")
    parser.add_argument(
        "--headset", metavar="SPEC", required=True,
        help="a service's configuration, virtual:NAME, or a virtual bench's TOML file",
    )  # fmt: skip
    parser.add_argument("--captures", metavar="N", type=int, default=24, help="at most so many (default 24)")
    parser.add_argument("--out", metavar="PHASE.png", type=Path, help="write the best pattern")
    parser.add_argument("--log", metavar="FILE.jsonl", type=Path, help="add a line for each capture")


def run(args: Namespace) -> dict[str, Any]:
    """Show, capture and refine; returns what `--json` prints."""
    from runtime.approximator import approximator_of
    from runtime.bundle import read_bundle
    from runtime.calibrated import bundle_channels, load_light_path
    from runtime.calibration.taking import Taker
    from runtime.calibration.view import View, view_of
    from runtime.devices import open_devices
    from runtime.refinement.eye import Eye
    from runtime.refinement.refine import Refinement, refine
    from runtime.solver import solve
    from runtime.solving import write_gray
    from runtime.targets import read_target

    if args.captures < 1:
        raise InputError(f"--captures {args.captures}: give 1 or more, and better 6")
    bundle = read_bundle(args.bundle)
    channels = bundle_channels(bundle)
    if len(channels) > 1:
        raise InputError(
            f"the bundle has {len(channels)} colours and their lasers would have to take turns, which a refinement "
            "does not do: export one colour"
        )
    path = load_light_path(bundle, channels[0])
    shape = path.grid.shape
    approximator = approximator_of(bundle, (1, *shape))
    if approximator is None:
        raise InputError("the bundle has no approximator to refine: train one and export it with the bundle")
    target = read_target(args.target, shape, fit=True)
    first = solve(path, target).phase
    opened = open(args.log, "a", encoding="utf-8") if args.log else nullcontext()  # noqa: SIM115 - closed below
    with opened as log, open_devices(args.headset) as devices:
        view = view_of(bundle)
        if view is None and tuple(devices.camera.shape) == shape:
            view = View(shape)
        if view is None or view.shape != tuple(devices.camera.shape):
            raise InputError(
                f"{args.bundle} does not know where this camera looks: run hololoop-runtime calibrate first"
            )
        state = Refinement([path], approximator, target[None], first.reshape(1, *shape), log)
        taker = Taker(devices, lambda what: None)
        black, _ = taker.darkness()
        try:
            taker.light(channels[0])
            taker.expose(state.gray[0], black)
            steps = refine(state, Eye(devices.panel, devices.camera, view, black), args.captures)
        finally:
            devices.lasers.off()
    if args.out:
        write_gray(args.out, state.gray[0])
    return {
        "captures": len(steps),
        "psnr_db": {"first": steps[0].psnr_db, "best": max(s.psnr_db for s in steps)},
        "heldout": {"first": steps[0].heldout, "last": steps[-1].heldout},
        "drift": steps[-1].drift,
        "stopped": state.stopped,
        "phase": str(args.out) if args.out else None,
        "log": str(args.log) if args.log else None,
    }


def show(result: dict[str, Any]) -> None:
    """One line, and where the pattern is."""
    psnr = result["psnr_db"]
    print(
        f"{psnr['first']:.1f} -> {psnr['best']:.1f} dB amplitude PSNR, seen by the camera, after {result['captures']} "
        f"captures ({result['stopped']})."
    )
    if result["phase"]:
        print(f"The best pattern is {result['phase']}.")
