"""Where several commands write: --out and --report."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

from firmware_iface.errors import InputError


def out_option(parser: ArgumentParser, metavar: str, what: str, required: bool = True) -> None:
    """--out."""
    parser.add_argument("--out", metavar=metavar, type=Path, required=required, help=what)


def report_option(parser: ArgumentParser) -> None:
    """--report."""
    parser.add_argument(
        "--report", metavar="FILE.html", type=Path, help="write a report with pictures, one HTML file"
    )


def refuse_folder(path: Path | None, option: str) -> None:
    """Say early that an output cannot be written, before the work is done.

    Raises
    ------
    InputError
        Where the path is a folder, or is in a folder that is not there.
    """
    if path is None:
        return
    if path.is_dir():
        raise InputError(f"{option} {path} is a folder: give the name of a file")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{option} {path}: there is no folder {path.absolute().parent}; make it first")
