"""`hololoop-trainer demo`: the whole way on a virtual bench."""

from __future__ import annotations

import itertools
from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.command import Command, Result
from runtime.program.interrupt import Interrupted
from runtime.program.outputs import Output, emptied
from runtime.program.screen import Screen
from trainer.commands.outputs import DEMO
from trainer.commands.workers import worker_options


def options(parser: ArgumentParser) -> None:
    """The options of `demo`."""
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="where the demo's files go (default: hololoop-demo, or if that is taken hololoop-demo-2 and so on)",
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="a smaller panel and fewer captures")
    size.add_argument(
        "--full-size",
        action="store_true",
        help="1080 x 1920 pixels, in three colours, for half an hour to an hour",
    )
    parser.add_argument(
        "--colour", action="store_true", help="three colours, shown in turn, and the report in colour"
    )
    worker_options(parser, cluster=False)


def run(args: Namespace, screen: Screen) -> Result:
    """The whole way on a virtual bench.

    Raises
    ------
    Interrupted
        After Ctrl-C, with a sentence on what is in the folder.
    """
    from trainer.cycle import demo_run

    what = demo_run.FULL_SIZE
    if not args.full_size:
        quick, usual = demo_run.QUICK, demo_run.USUAL
        if args.colour:
            quick, usual = demo_run.QUICK_COLOUR, demo_run.COLOUR
        what = quick if args.quick else usual
    folder = args.out or first_free(Path("hololoop-demo"))
    if args.overwrite:
        emptied(folder)
    try:
        with screen.progress("demo") as progress:
            return dict(demo_run.run_demo(folder, what, workers=args.workers, progress=progress))
    except KeyboardInterrupt:
        raise Interrupted(_interrupted(folder)) from None


def _interrupted(folder: Path) -> str:
    """What is left of a demo after Ctrl-C."""
    from trainer.formatting import listed

    there = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    if not there:
        return "interrupted before anything was written"
    return f"interrupted; {folder} holds {listed(there)}"


def outputs(args: Namespace) -> list[Output]:
    """The folder that was named; without one, a new name is found."""
    return [Output(args.out, contents=DEMO, makes_folders=True)] if args.out else []


def first_free(folder: Path) -> Path:
    """The folder, or the first of FOLDER-2, FOLDER-3 ... that is not there yet."""
    names = itertools.chain([folder], (folder.with_name(f"{folder.name}-{k}") for k in itertools.count(2)))
    return next(name for name in names if not name.exists())


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What came out."""
    screen.say(str(result["sentence"]), style="bold")
    if channels := result.get("channels"):
        screen.table(
            ("PSNR, dB", *channels, "together"),
            [
                (which, *(one[which]["psnr_db"] for one in channels.values()), together["psnr_db"])
                for which, together in result["display"].items()
            ],
        )
    screen.facts({k: v for k, v in result.items() if k != "sentence"})


COMMAND = Command(
    name="demo",
    about="Go the whole way on a virtual bench: capture, explain, export, show.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("demo --quick",),
    after="Do the same with your own captures: check captures/",
)
