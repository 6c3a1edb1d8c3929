"""`hololoop-runtime refine`: a picture made better while a camera looks at it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from firmware_iface.errors import InputError
from runtime.commands.inputs import bundle_argument, headset_option, say_simulated
from runtime.program.command import Command, Result
from runtime.program.outputs import Output, check_outputs
from runtime.program.screen import Screen

DESCRIPTION = """Show a picture, look at it with the headset's camera, and make it better while it is displayed.

Each capture moves the pattern, and draws the bundle's approximator towards what the camera saw. Every third one is held
out; where those are predicted worse than before, the refinement stops and goes back to the best. The bundle is not
changed. The laser is switched on before and off after, and is not touched in between; several take turns, one lit at a
time and each at its own power throughout. Where the headset's configuration has fields in turn, each is lit in its
own field alone. For bundles that were exported with a network, and whose camera a calibration has seen."""


def options(parser: ArgumentParser) -> None:
    """The options of `refine`."""
    bundle_argument(parser)
    parser.add_argument("target", metavar="TARGET", type=Path, help="picture to show, of any size")
    headset_option(parser, required=True)
    parser.add_argument("--captures", metavar="N", type=int, default=24, help="at most so many (default 24)")
    parser.add_argument(
        "--out",
        metavar="PHASE.png",
        type=Path,
        help="write the best pattern; with several colours NAME-red.png and so on",
    )
    parser.add_argument("--log", metavar="FILE.jsonl", type=Path, help="add a line for each capture")


def run(args: Namespace, screen: Screen) -> Result:
    """Show, capture and refine."""
    import numpy as np

    from runtime.bundle.bundle_folder import read_bundle
    from runtime.bundle.light_path_arrays import bundle_channels, load_light_path, slow_response_share
    from runtime.calibration.taking import Taker
    from runtime.camera.view import View, view_of
    from runtime.headset.colour_fields import open_colours
    from runtime.headset.open_devices import is_simulated
    from runtime.lightpath.overdrive import settling_periods
    from runtime.networks.onnx_approximator import approximator_of
    from runtime.refinement.panel_and_camera import PanelAndCamera
    from runtime.refinement.picture_refinement import Refinement, refine
    from runtime.solver import solve
    from runtime.solver.pattern_files import pattern_files, write_pattern
    from runtime.solver.targets import channel_targets

    if args.captures < 1:
        raise InputError(f"--captures {args.captures}: give 1 or more, and better 6")
    bundle = read_bundle(args.bundle)
    channels = bundle_channels(bundle)
    outs = [file.out for file in pattern_files([args.target], channels, args.out)] if args.out else []
    check_outputs([Output(out, makes_folders=True) for out in outs], args)
    paths = [load_light_path(bundle, c) for c in channels]
    shape = paths[0].grid.shape
    approximator = approximator_of(bundle, (len(paths), *shape))
    if approximator is None:
        raise InputError("the bundle has no approximator to refine: train one and export it with the bundle")
    targets = channel_targets(args.target, shape, channels, fit=True, colour=len(channels) > 1)
    target = np.stack([targets[c] for c in channels])
    first = np.stack([solve(path, t).phase for path, t in zip(paths, target, strict=True)])
    opened = open(args.log, "a", encoding="utf-8") if args.log else nullcontext()  # noqa: SIM115 - closed below
    with opened as log, open_colours(args.headset, channels) as devices:
        view = view_of(bundle)
        if view is None and tuple(devices.camera.shape) == shape:
            view = View(shape)
        if view is None or view.shape != tuple(devices.camera.shape):
            raise InputError(
                f"{args.bundle} does not know where this camera looks: run hololoop-runtime calibrate first"
            )
        state = Refinement(paths, approximator, target, first, log)
        settling = settling_periods(slow_response_share(bundle))
        taker = Taker(devices, lambda what: None, settling=settling)
        black, _ = taker.darkness()
        exposures: dict[str, float] = {}

        def turn(channel: str) -> None:
            taker.light(channel)
            devices.camera.exposure_ms = exposures[channel]

        try:
            for channel, gray in zip(channels, state.gray, strict=True):
                taker.light(channel)
                exposures[channel] = taker.expose(gray, black)
            turns = [partial(turn, c) for c in channels] if len(channels) > 1 else None
            seen = PanelAndCamera(devices.panel, devices.camera, view, black, turns, settling)
            steps = refine(state, seen, args.captures)
        finally:
            devices.lasers.off()
    for out, gray in zip(outs, state.gray if outs else [], strict=True):
        write_pattern(out, gray)
    return {
        "captures": len(steps),
        "simulated": is_simulated(args.headset),
        "psnr_db": {"first": steps[0].psnr_db, "best": state.best_psnr_db},
        "heldout": {"first": steps[0].heldout, "last": steps[-1].heldout},
        "drift": steps[-1].drift,
        "stopped": state.stopped,
        "patterns": {channel: str(out) for channel, out in zip(channels if outs else [], outs, strict=True)},
        "log": str(args.log) if args.log else None,
    }


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """One line, and where the pattern is."""
    say_simulated(result, screen)
    psnr = result["psnr_db"]
    screen.say(
        f"{psnr['first']:.1f} -> {psnr['best']:.1f} dB amplitude PSNR, seen by the camera, after {result['captures']} "
        f"captures ({result['stopped']})."
    )
    for out in result["patterns"].values():
        screen.say(f"The best pattern is {out}.")


COMMAND = Command(
    name="refine",
    about="Make a picture better while a camera looks at it.",
    options=options,
    run=run,
    show=show,
    examples=("refine bundle/ picture.png --headset headset.toml --out pattern.png --log drift.jsonl",),
    after="Show the pattern: show pattern.png --headset headset.toml",
    description=DESCRIPTION,
)
