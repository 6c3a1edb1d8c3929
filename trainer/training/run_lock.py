"""One training in a folder at a time: a file with the number of the process, locked while it runs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from firmware_iface.errors import InputError

RUNNING = "running"  # the file's name


@contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Keep other trainings out of a folder within the block.

    The system drops the lock of a process that has ended in any way, so a file that was left is taken over.

    Raises
    ------
    InputError
        Where another training runs in the folder, and where the folder cannot be written.
    """
    path = folder / RUNNING
    try:
        file = _locked(path)
    except BlockingIOError:
        with suppress(OSError):
            number = path.read_text(encoding="utf-8").strip()
            raise InputError(
                f"another training runs in {folder} (process {number}): wait for its end, or give another --out"
            ) from None
        raise InputError(f"another training runs in {folder}: give another --out") from None
    except OSError as error:
        raise InputError(
            f"--out {folder} cannot be written ({error.strerror}): give another folder"
        ) from None
    with file:
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()


def _locked(path: Path) -> IO[str]:
    """The file, opened and locked; BlockingIOError where another process holds it."""
    import fcntl

    while True:
        file = open(path, "a", encoding="utf-8")  # noqa: SIM115 - the caller closes it
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.exists(path) and os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                return file
        except BaseException:
            file.close()
            raise
        file.close()  # the process that held it has just removed it: this one locked a file without a name
