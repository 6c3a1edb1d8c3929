"""The options that every command has for what it says: --json, --csv, --quiet, --verbose and --log."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path


def screen_options(parser: ArgumentParser) -> None:
    """Declare them; a command that has an option of the same name keeps its own."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object on stdout and nothing else there"
    )
    parser.add_argument(
        "--csv", metavar="FILE.csv", type=Path, help="write the tables that are printed to a file, as CSV"
    )
    how_much = parser.add_mutually_exclusive_group()
    how_much.add_argument("--quiet", action="store_true", help="say nothing of the progress")
    how_much.add_argument("--verbose", action="store_true", help="a line for every step of the progress")
    parser.set_defaults(log_file=None)
    if "--log" not in option_names(parser):
        parser.add_argument(
            "--log",
            metavar="FILE",
            type=Path,
            dest="log_file",
            help="add all that is said to a file, each line with its time",
        )


def option_names(parser: ArgumentParser) -> list[str]:
    """The long names of a parser's options."""
    return [name for action in parser._actions for name in action.option_strings if name.startswith("--")]
