"""initialiser: a network that proposes the headset's first phase."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.solving import whole
from trainer.commands.command import Command, Result, out_option, use_every_core
from trainer.commands.screen import Screen
from trainer.commands.training import seed_option


def run_initialiser(args: Namespace, screen: Screen) -> Result:
    """A bundle with an initialiser that was taught on its own solver's results."""
    from trainer.training.train_initialiser import with_initialiser

    use_every_core()
    with screen.progress("solving") as told:
        found = with_initialiser(args.bundle, args.steps, args.out, told, args.seed)
    return {"bundle": str(args.out), "steps": args.steps, "heldout_psnr_db": found}


def show_initialiser(result: Result, args: Namespace, screen: Screen) -> None:
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


def _options(parser: ArgumentParser) -> None:
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


def commands() -> list[Command]:
    """The command of this file."""
    return [
        Command(
            "initialiser",
            "Teach a small network to propose the solver's first phase.",
            "initialiser bundle/ --out bundle-started/",
            "Solve with it: hololoop-runtime solve bundle-started/ picture.png --iterations 3 --out pattern.png",
            _options,
            run_initialiser,
            show_initialiser,
        )
    ]
