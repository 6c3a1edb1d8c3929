"""`hololoop-trainer initialiser`: a network that proposes the headset's first phase."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.command import Command, Result
from runtime.program.options import seed_option, whole
from runtime.program.outputs import Output
from runtime.program.screen import Screen
from trainer.commands.outputs import BUNDLE, out_option
from trainer.commands.workers import use_every_core


def options(parser: ArgumentParser) -> None:
    """The options of `initialiser`."""
    parser.add_argument(
        "bundle", metavar="BUNDLE", type=Path, help="folder that export wrote, of one colour and plane"
    )
    out_option(parser, "NEW", "folder for the same bundle with initialiser.onnx")
    parser.add_argument(
        "--steps",
        metavar="N",
        type=whole(0, 10**7),
        default=4000,
        help="batches to learn from (default 4000)",
    )
    seed_option(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """A bundle with an initialiser that was taught on its own solver's results."""
    from trainer.training.train_initialiser import with_initialiser

    use_every_core()
    with screen.progress("solving") as progress:
        found = with_initialiser(args.bundle, args.steps, args.out, progress, args.seed, args.overwrite)
    return {"bundle": str(args.out), "steps": args.steps, "heldout_psnr_db": found}


def outputs(args: Namespace) -> list[Output]:
    """The new bundle."""
    return [Output(args.out, contents=BUNDLE)]


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """How far a few iterations get from it and from double phase."""
    held = result["heldout_psnr_db"]
    counts = [str(k) for k in range(len(held["initialiser"]))]
    rows = [(which.replace("_", " "), *values) for which, values in held.items()]
    screen.table(("dB on pictures not learned from, after iterations", *counts), rows)
    better = held["initialiser"][-1] > held["double_phase"][-1]
    screen.say(
        f"\nThe bundle is {result['bundle']}; "
        + (
            "its solver now begins with the network."
            if better
            else "double phase is the better start: keep the old one."
        )
    )


COMMAND = Command(
    name="initialiser",
    about="Teach a small network to propose the solver's first phase.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("initialiser bundle/ --out bundle-started/",),
    after="Solve with it: hololoop-runtime solve bundle-started/ picture.png --iterations 3 --out pattern.png",
)
