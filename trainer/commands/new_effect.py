"""`hololoop-trainer new-effect`: a file with an effect to edit, and its test."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from tempfile import TemporaryDirectory

from runtime.program.command import Command, Result
from runtime.program.options import one_of
from runtime.program.outputs import Output
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import effects_option

STAGES = ("drive", "panel", "pupil", "sensor")


def options(parser: ArgumentParser) -> None:
    """The options of `new-effect`."""
    parser.add_argument("name", metavar="NAME", help="lower-case letters, digits and underscores")
    parser.add_argument(
        "--stage",
        metavar="S",
        required=True,
        type=one_of(STAGES, "a stage"),
        help="drive, panel, pupil or sensor",
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path(), help="where the two files go (default: here)"
    )
    effects_option(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """A file with an effect to edit, and its test."""
    from runtime.bundle.whole_files import whole_file
    from trainer.effects.effect_catalogue import catalogue
    from trainer.effects.new_effect import write_new_effect

    known = catalogue(args.effects)
    if args.overwrite:
        with TemporaryDirectory() as folder:
            for path in write_new_effect(args.name, args.stage, Path(folder), known):
                args.out.mkdir(parents=True, exist_ok=True)
                with whole_file(args.out / path.name) as file:
                    file.write(path.read_bytes())
    else:
        write_new_effect(args.name, args.stage, args.out, known)
    effect, test = (str(output.path) for output in outputs(args))
    return {"effect": effect, "test": test, "stage": args.stage}


def outputs(args: Namespace) -> list[Output]:
    """The effect's file and its test."""
    names = (f"{args.name}.py", f"test_{args.name}.py")
    return [Output(args.out / name, makes_folders=True) for name in names]


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The files, and how to use them."""
    screen.say(
        f"{result['effect']} holds an effect that works as it is; edit it. {result['test']} tests it.",
        style="bold",
    )
    screen.next(f"pytest {result['test']}", "Test it")
    screen.next(
        command_line("diagnose", "captures/", "--effects", result["effect"]), "Look for it in captures"
    )


COMMAND = Command(
    name="new-effect",
    about="Write a file with a working effect to edit, and its test.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("new-effect drive_ripple --stage drive",),
    after="Test it with pytest, then look for it: diagnose captures/ --effects drive_ripple.py",
)
