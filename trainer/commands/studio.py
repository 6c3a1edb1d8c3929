"""`hololoop-trainer studio`: the page in which a bench is explained with the mouse."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from firmware_iface.errors import InputError
from runtime.program.command import Command, Result
from runtime.program.options import whole
from runtime.program.screen import Screen
from trainer.commands.inputs import effects_option


def options(parser: ArgumentParser) -> None:
    """The options of `studio`."""
    parser.add_argument(
        "captures",
        metavar="CAPTURES",
        type=Path,
        nargs="?",
        help="folder of a capture set (default: the page asks for one)",
    )
    parser.add_argument(
        "--model",
        metavar="M.toml",
        type=Path,
        help="the model file that the page works on; made at the first change (default: NAME-model.toml here)",
    )
    effects_option(parser)
    parser.add_argument(
        "--port", metavar="P", type=whole(1, 65535), default=None, help="of the page (default: a free one)"
    )
    parser.add_argument(
        "--token",
        metavar="T",
        default=None,
        help="what the address must carry (default: a new one each time)",
    )
    parser.add_argument("--no-browser", action="store_true", help="print the address and open no browser")


def run(args: Namespace, screen: Screen) -> Result:
    """Serve the page until Ctrl-C.

    Raises
    ------
    InputError
        Where panel is not installed, the port is in use, or the captures cannot be opened at all.
    """
    try:
        from trainer.studio.server import serve
    except ImportError as error:
        if (error.name or "").split(".")[0] not in ("panel", "bokeh", "param", "tornado"):
            raise
        raise InputError(
            f"the studio needs {error.name}, which is not installed: pip install 'hololoop[studio]'"
        ) from error

    def ready(address: str) -> None:
        line = f"The studio is at {address}"
        if args.json:
            print(line, file=sys.stderr, flush=True)
        else:
            screen.say(line, style="bold")
            screen.say("Ctrl-C ends it.")
            sys.stdout.flush()

    served = serve(
        args.captures,
        args.model,
        tuple(args.effects),
        port=args.port,
        token=args.token,
        browser=not args.no_browser,
        ready=ready,
    )
    return {"address": served.address, "captures": served.captures, "model": served.model}


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """Where the work is."""
    if result["model"]:
        screen.say(f"The model is {result['model']}.")


COMMAND = Command(
    name="studio",
    about="Open the page in which a bench is explained with the mouse.",
    options=options,
    run=run,
    show=show,
    examples=("studio captures/",),
    after="The model is an ordinary model file: go on with it on the command line, or export it to the headset.",
)
