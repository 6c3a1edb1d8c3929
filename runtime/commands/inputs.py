"""What several commands are given: a bundle, and a headset."""

from __future__ import annotations

from argparse import ArgumentParser, _ActionsContainer
from pathlib import Path

from runtime.program.command import Result
from runtime.program.screen import Screen


def bundle_argument(parser: ArgumentParser, what: str = "folder that hololoop-trainer exported") -> None:
    """The bundle."""
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help=what)


def headset_option(parser: _ActionsContainer, required: bool) -> None:
    """--headset, in a parser or in a group of options."""
    parser.add_argument(
        "--headset",
        metavar="SPEC",
        required=required,
        help="a service's configuration, virtual:NAME, or a virtual bench's TOML file",
    )


def say_simulated(result: Result, screen: Screen) -> None:
    """A line where the result is of a simulated bench."""
    if result["simulated"]:
        screen.say("Simulated: no real headset was used.", style="yellow")
