"""`hololoop-trainer export`: a model as a bundle for the headset."""

from __future__ import annotations

import shlex
from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.command import Command, Result
from runtime.program.outputs import Output
from runtime.program.screen import Screen
from trainer.commands.inputs import effects_option
from trainer.commands.outputs import BUNDLE, out_option
from trainer.commands.workers import use_every_core


def options(parser: ArgumentParser) -> None:
    """The options of `export`."""
    parser.add_argument("--model", metavar="M.toml", type=Path, required=True, help="the model")
    out_option(parser, "BUNDLE", "folder of the new bundle")
    parser.add_argument(
        "--captures",
        metavar="CAPTURES",
        type=Path,
        help="the capture set that the model explains: its hash and the held-out errors go into the bundle",
    )
    parser.add_argument(
        "--network",
        metavar="FILE",
        type=Path,
        help="a trained approximator, RUN/network.safetensors, to go in as ONNX",
    )
    effects_option(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """A model as a bundle for the headset."""
    from trainer.captures.capture_set import read_captures
    from trainer.effects.effect_catalogue import catalogue
    from trainer.model.bundle_export import export_bundle
    from trainer.model.model_file import read_model

    captures = read_captures(args.captures) if args.captures else None
    model = read_model(args.model, catalogue(args.effects), captures.bench if captures else None)
    use_every_core()
    return dict(export_bundle(model, captures, args.out, network=args.network, replace_folder=args.overwrite))


def outputs(args: Namespace) -> list[Output]:
    """The bundle."""
    return [Output(args.out, contents=BUNDLE)]


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What is in the bundle."""
    screen.say(f"The bundle is {args.out}.", style="bold")
    screen.facts(result)
    screen.next(
        shlex.join(["hololoop-runtime", "solve", str(args.out), "picture.png", "--out", "phase.png"]),
        "On the headset",
    )


COMMAND = Command(
    name="export",
    about="Make a bundle for the headset of a model.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("export --model model.toml --out bundle/",),
    after="On the headset: hololoop-runtime solve bundle/ picture.png --out phase.png",
)
