"""What a command writes, and the one rule for all outputs, which is applied before any work.

Nothing that is there is replaced without `--overwrite`; a folder is replaced only where it holds nothing but what the
command writes itself; an input is never replaced, except a model by the one that goes on from it.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from firmware_iface.errors import InputError

WRITTEN = (
    "out",
    "report",
    "log",
    "log_file",
    "csv",
    "units",
)  # options that name outputs; all other paths are inputs
PARTS_OF_INPUTS = (
    "bench.toml",
    "captures.csv",
    "bundle.json",
)  # files of folders that are given as one input


@dataclass(frozen=True)
class Output:
    """A file or a folder that a command writes.

    Attributes
    ----------
    path : Path
    option : str
        The option that names it.
    contents : tuple of str or None
        Of a folder: patterns of all names that the command writes in it. None: it is a file.
    goes_on_from : Path or None
        The input that it may replace.
    resumed_by : tuple of str
        Of a folder: names in it with one of which the command goes on, so that nothing is replaced.
    makes_folders : bool
        Whether the command makes the folder that it is in.
    goes_on : bool
        Of a file: whether it is this command's own, which it goes on with, so that nothing is lost.
    """

    path: Path
    option: str = "--out"
    contents: tuple[str, ...] | None = None
    goes_on_from: Path | None = None
    resumed_by: tuple[str, ...] = ()
    makes_folders: bool = False
    goes_on: bool = False

    def __str__(self) -> str:
        return f"{self.option} {self.path}"


def overwrite_option(parser: ArgumentParser) -> None:
    """--overwrite."""
    parser.add_argument(
        "--overwrite", action="store_true", help="replace outputs that are there; without it they are refused"
    )


def files_written(**paths: Path | None) -> list[Output]:
    """The files that options name, such as `report=args.report`; an option that was not given names none."""
    return [Output(path, f"--{option}") for option, path in paths.items() if path is not None]


def check_outputs(outputs: Sequence[Output], args: Namespace) -> None:
    """Refuse outputs that cannot or must not be written.

    Parameters
    ----------
    outputs : sequence of Output
    args : Namespace
        The command's arguments: its paths, and `overwrite`.

    Raises
    ------
    InputError
        Where something is there already without --overwrite, is of the wrong kind, is an input or another output, or
        where the folder that it goes to is not there or not writable.
    """
    inputs = list(_inputs(args))
    seen: dict[str, Output] = {}
    for output in outputs:
        place = os.path.realpath(output.path)
        if place in seen:
            raise InputError(f"{seen[place]} and {output} are one file: give two names")
        seen[place] = output
        mode = _mode(output)
        for one in inputs:
            _refuse_input(output, place, one, args.overwrite)
        if mode is None:
            _check_parent(output)
        elif stat.S_ISDIR(mode):
            _check_folder(output, args.overwrite)
        else:
            _check_file(output, mode)
        if mode is not None and not stat.S_ISDIR(mode) and not (args.overwrite or output.goes_on):
            raise InputError(f"{output} is there already: give another name, or --overwrite to replace it")


def emptied(folder: Path, keep: str = "") -> None:
    """Remove what is in a folder that `check_outputs` allowed to be replaced, except the name `keep`."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if path.name == keep:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _inputs(args: Namespace) -> Iterator[Path]:
    """The files and folders that a command is given to read."""
    for name, value in vars(args).items():
        if name in WRITTEN:
            continue
        for one in value if isinstance(value, list | tuple) else (value,):
            if isinstance(one, Path):
                yield one
            elif name in ("bench", "headset") and isinstance(one, str) and os.path.exists(one):
                yield Path(one)  # these may be virtual:NAME as well


def _mode(output: Output) -> int | None:
    """Type and rights of what is there; None where nothing is."""
    try:
        return os.stat(output.path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None  # the folder above is looked at next
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise InputError(
                f"{output} is a symbolic link that leads to itself: remove it or give another name"
            ) from None
        raise InputError(f"{output} cannot be written ({error.strerror}): give another name") from None


def _check_parent(output: Output) -> None:
    """The folder that a new output goes to."""
    parent = Path(os.path.realpath(output.path)).parent
    if output.makes_folders:
        while not parent.exists() and parent != parent.parent:
            parent = parent.parent
    if not parent.is_dir():
        if parent.exists():
            raise InputError(f"{output}: {parent} is a file, not a folder; give another name")
        above = next((p for p in parent.parents if p.exists()), parent)
        if not above.is_dir():
            raise InputError(f"{output}: {above} is a file, not a folder; give another name")
        raise InputError(f"{output}: there is no folder {parent}; make it first")
    _check_writable(output, parent)


def _check_writable(output: Output, folder: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(
            f"{output}: this user may not write in {folder}; give another name or change its rights"
        )


def _check_file(output: Output, mode: int) -> None:
    """Something that is there and is not a folder."""
    if output.contents is not None:
        raise InputError(f"{output} is a file: give the name of a folder")
    if not stat.S_ISREG(mode):
        raise InputError(f"{output} is not an ordinary file: give another name")
    _check_writable(output, Path(os.path.realpath(output.path)).parent)


def _check_folder(output: Output, overwrite: bool) -> None:
    """A folder that is there."""
    if output.contents is None:
        raise InputError(f"{output} is a folder: give the name of a file")
    try:
        names = sorted(os.listdir(output.path))
    except OSError as error:
        raise InputError(f"{output} cannot be read ({error.strerror}): give another folder") from None
    _check_writable(output, output.path)
    if not names or (not overwrite and any(name in names for name in output.resumed_by)):
        return
    if not overwrite:
        raise InputError(
            f"{output} is there already and is not empty: give another folder, or --overwrite to replace it"
        )
    other = [n for n in names if not any(fnmatch(n, pattern) for pattern in output.contents)]
    if other:
        raise InputError(
            f"{output} holds {other[0]}, which this command does not write: it is not replaced; move that "
            "away, or give another folder"
        )


def _refuse_input(output: Output, place: str, given: Path, overwrite: bool) -> None:
    """Refuse an output that would replace something that the command reads."""
    source = os.path.realpath(given)
    if place == source:
        if output.goes_on_from is not None and os.path.realpath(output.goes_on_from) == source:
            return
        raise InputError(f"{output} is an input of this command: give another name")
    if overwrite and output.contents is not None and Path(source).is_relative_to(place):
        raise InputError(f"{output} holds {given}, an input of this command: give another folder")
    if os.path.dirname(place) == source and os.path.basename(place) in PARTS_OF_INPUTS:
        raise InputError(f"{output} is a part of {given}, an input of this command: give another name")
