"""What a capture set's tables say: whose it is, when it was taken, and whether it has changed."""

from __future__ import annotations

import hashlib
import os
from datetime import UTC, datetime
from pathlib import Path

from firmware_iface.errors import InputError
from trainer.captures.capture_set import CaptureSet, opened
from trainer.fleet.set_result import SetFacts

TAKEN_AT = "taken_at"  # a column of captures.csv


def set_facts(folder: Path, model: Path | None) -> SetFacts:
    """The facts of a set; of a folder that cannot be read, its name alone.

    Parameters
    ----------
    folder : Path
    model : Path or None
        That its fit starts from.
    """
    folder = folder.absolute()
    try:
        captures = opened(folder)
        time, time_from = time_of(captures)
        stamp = _stamp(captures, model)
    except (InputError, OSError):  # whoever works on the set says what is wrong
        return SetFacts(str(folder), folder.name, "folder")
    name = captures.bench.name.strip()
    who, who_from = (name, "bench.toml") if name else (folder.name, "folder")
    return SetFacts(str(folder), who, who_from, time, time_from, stamp)


def time_of(captures: CaptureSet) -> tuple[datetime, str]:
    """When a set was taken, UTC, and where that is from.

    That is `taken_at` of the first capture, ISO 8601, where captures.csv has that column; a time without a zone is UTC.
    Otherwise it is the time of the first picture's file.

    Raises
    ------
    InputError
        Where `taken_at` is not a time.
    """
    first = captures.captures[0].rows[0]
    text = first.extra.get(TAKEN_AT, "")
    if not text:
        return datetime.fromtimestamp(first.image.stat().st_mtime, UTC), "file"
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(
            f"{captures.folder / 'captures.csv'}, capture {first.capture}: {TAKEN_AT} is {text[:40]!r}; "
            "write a date and time such as 2026-03-01T14:30:00+01:00"
        ) from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).astimezone(UTC), "captures.csv"


def _stamp(captures: CaptureSet, model: Path | None) -> str:
    files = [captures.folder / "bench.toml", captures.folder / "captures.csv"]
    files += [path for c in captures.captures for row in c.rows for path in (row.phase, row.image)]
    digest = hashlib.sha256()
    for path in dict.fromkeys(files):
        state = path.stat()
        name = Path(os.path.relpath(path, captures.folder)).as_posix()
        digest.update(f"{name}\n{state.st_size}\n{state.st_mtime_ns}\n".encode())
    if model is not None:
        digest.update(hashlib.sha256(model.read_bytes()).digest())
    return digest.hexdigest()
