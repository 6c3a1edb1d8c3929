"""The file of `--log`: all that a command says, each line with its time, added to what is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from firmware_iface.errors import InputError

Log = Callable[[str], None]


def no_log(text: str) -> None:
    """Write nothing: the log of a command without `--log`."""


@contextmanager
def open_log(path: Path | None) -> Iterator[Log]:
    """Give a function that adds text to a file, a time in front of each of its lines.

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    if path is None:
        yield no_log
        return
    try:
        file = open(path, "a", encoding="utf-8", buffering=1)  # noqa: SIM115 - closed below
    except OSError as error:
        raise InputError(f"--log {path} cannot be written ({error.strerror}): give another name") from None

    def log(text: str) -> None:
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        lines = [line.rstrip() for line in text.splitlines() if line.strip()]
        try:
            file.writelines(f"{now} {line}\n" for line in lines)
        except OSError as error:
            raise InputError(f"--log {path} cannot be written ({error.strerror})") from None

    with file:
        yield log
