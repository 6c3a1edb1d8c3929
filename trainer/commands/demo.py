"""`hololoop-trainer demo`: the whole way on a virtual bench."""

from __future__ import annotations

import itertools
from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.command import Command, Result
from runtime.program.screen import Screen
from trainer.commands.workers import worker_options


def options(parser: ArgumentParser) -> None:
    """The options of `demo`."""
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="where the demo's files go (default: hololoop-demo, or if that is taken hololoop-demo-2 and so on)",
    )
    parser.add_argument("--quick", action="store_true", help="a smaller panel and fewer captures")
    worker_options(parser, cluster=False)


def run(args: Namespace, screen: Screen) -> Result:
    """The whole way on a virtual bench."""
    from trainer.cycle.demo_run import run_demo

    folder = args.out or first_free(Path("hololoop-demo"))
    with screen.progress("demo") as progress:
        return dict(run_demo(folder, quick=args.quick, workers=args.workers, progress=progress))


def first_free(folder: Path) -> Path:
    """The folder, or the first of FOLDER-2, FOLDER-3 ... that is not there yet."""
    names = itertools.chain([folder], (folder.with_name(f"{folder.name}-{k}") for k in itertools.count(2)))
    return next(name for name in names if not name.exists())


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What came out."""
    screen.say(str(result["sentence"]), style="bold")
    screen.facts({k: v for k, v in result.items() if k != "sentence"})


COMMAND = Command(
    name="demo",
    about="Go the whole way on a virtual bench: capture, explain, export, show.",
    options=options,
    run=run,
    show=show,
    examples=("demo --quick",),
    after="Do the same with your own captures: check captures/",
)
