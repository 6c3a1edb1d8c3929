"""captures.csv, the table of a capture set: one row for each capture, read with everything that is wrong with it."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

from trainer.captures.bench_file import Bench
from trainer.captures.png_reader import reason

REQUIRED = ("capture", "channel", "phase", "image")
KNOWN = (*REQUIRED, "plane_mm", "pattern", "exposure_ms", "time_s", "bracket")


@dataclass(frozen=True)
class Moment:
    """When a capture was taken.

    Attributes
    ----------
    number : float
        Captures of the set that were taken before it; a bracket is one capture.
    time_s : float, s
        From the first capture; the row's number where the set does not give it.
    """

    number: float
    time_s: float


@dataclass(frozen=True)
class Capture:
    """One row of captures.csv, or the rows of one exposure bracket.

    Attributes
    ----------
    capture : str
        Its id.
    channel : str
        Name of the bench's channel.
    plane_mm : float, mm
        Panel to image plane, as set on the bench.
    pattern : str
        Rows of one pattern show the same gray levels. `read_captures` gives rows with the same gray levels one name.
    phase, image : Path
        The panel's pattern and the camera's picture, absolute.
    exposure_ms : float, ms
    time_s : float, s
        From the first capture; the row's number where the set does not give it.
    extra : dict
        The columns that this reader does not know, as text.
    bracket : str
        Rows with the same text are one exposure bracket; "" for a row by itself.
    frames : tuple of Capture
        The rows of a bracket, the shortest exposure first; empty for a row by itself.
    """

    capture: str
    channel: str
    plane_mm: float
    pattern: str
    phase: Path
    image: Path
    exposure_ms: float = 1.0
    time_s: float = 0.0
    extra: dict[str, str] = field(default_factory=dict)
    bracket: str = ""
    frames: tuple[Capture, ...] = ()

    @property
    def rows(self) -> tuple[Capture, ...]:
        """The rows of captures.csv that this is: itself, or a bracket's frames, the shortest exposure first."""
        return self.frames or (self,)


def ids_of(captures: Iterable[Capture]) -> tuple[str, ...]:
    """Ids of captures, in their order: what a task for another process is given in their place."""
    return tuple(c.capture for c in captures)


@dataclass(frozen=True)
class RowFault:
    """One thing that is wrong with captures.csv.

    Attributes
    ----------
    kind : str
        As in `trainer.captures.problems.Problem`.
    capture : str
        The capture's id; "" for the whole file.
    message : str
        One sentence.
    """

    kind: str
    capture: str
    message: str


def scan_rows(folder: Path, bench: Bench) -> tuple[list[Capture], list[RowFault]]:
    """All usable rows of a folder's captures.csv, and everything that is wrong with the file; never raises.

    Parameters
    ----------
    folder : Path
        Of the capture set.
    bench : Bench
        Its channels and distance.

    Returns
    -------
    list of Capture
        The rows that can be used.
    list of RowFault
        A row with a fault that leaves no doubt about what was captured (a duplicate id) is in both lists.
    """
    path = folder / "captures.csv"
    try:
        text = path.read_text(encoding="utf-8-sig")
        table = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except OSError as error:
        return [], [
            RowFault(
                "unreadable",
                "",
                f"{path} cannot be read ({error.strerror}): "
                "a capture set needs a captures.csv with one row for each capture",
            )
        ]
    except (UnicodeDecodeError, csv.Error) as error:
        return [], [
            RowFault(
                "unreadable",
                "",
                f"{path} is not a comma-separated UTF-8 table ({reason(error)}): save it again as CSV, UTF-8",
            )
        ]
    numbered = [(n, row) for n, row in enumerate(table, 1) if any(cell.strip() for cell in row)]
    header = [cell.strip() for cell in numbered[0][1]] if numbered else []
    fault = _header_fault(path, header, len(numbered))
    if fault:
        return [], [fault]
    captures: list[Capture] = []
    faults: list[RowFault] = []
    ids: set[str] = set()
    files = _Files(folder)
    for number, row in numbered[1:]:
        cells = dict(zip(header, (cell.strip() for cell in row), strict=False))
        name = cells.get("capture", "")
        where = f"captures.csv row {number} (capture {name})" if name else f"captures.csv row {number}"
        if len(row) != len(header):
            faults.append(
                RowFault(
                    "unreadable",
                    name,
                    f"{where} has {len(row)} cells, but the header has "
                    f"{len(header)}: correct the row, with quotes around text with commas",
                )
            )
            continue
        capture, wrong = _row(files, bench, cells, where, len(captures))
        if name in ids:
            wrong.insert(
                0,
                RowFault(
                    "duplicate",
                    name,
                    f"{where} repeats the id of an earlier row: give every capture its own id",
                ),
            )
        ids.add(name)
        faults += wrong
        if capture:
            captures.append(capture)
    return captures, faults


def _header_fault(path: Path, header: list[str], rows: int) -> RowFault | None:
    if not header:
        return RowFault("unreadable", "", f"{path} is empty: give it the columns {', '.join(REQUIRED)}")
    for column in REQUIRED:
        if column not in header:
            near = get_close_matches(column, header, 1)
            hint = f"rename the column {near[0]!r}" if near else "add it"
            if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
                hint = "separate the columns with commas"
            return RowFault("unreadable", "", f"{path} has no column {column!r}: {hint}")
    twice = [column for column in dict.fromkeys(header) if header.count(column) > 1]
    if twice:
        return RowFault("unreadable", "", f"{path} has two columns {twice[0]!r}: keep one")
    if rows < 2:
        return RowFault("too_few", "", f"{path} has no captures: add one row for each capture")
    return None


class _Files:
    """The files of a set: its folders are listed once, which is quicker than to ask for each of many files.

    Parameters
    ----------
    folder : Path
        Of the set.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._names: dict[str, set[str]] = {}  # of files, by folder

    def has(self, relative: str) -> bool:
        """Whether there is such a file."""
        parent, _, name = relative.rpartition("/")
        if parent not in self._names:
            try:
                with os.scandir(self.folder / parent) as entries:
                    self._names[parent] = {entry.name for entry in entries if entry.is_file()}
            except OSError:
                self._names[parent] = set()
        if name in self._names[parent]:
            return True
        try:  # a disk may take other spellings for the same
            return (self.folder / relative).is_file()
        except OSError:
            return False


def _row(
    set_files: _Files, bench: Bench, cells: dict[str, str], where: str, index: int
) -> tuple[Capture | None, list[RowFault]]:
    """The capture that a row of cells describes (None where it cannot be known), and the row's faults."""
    faults: list[RowFault] = []
    name = cells["capture"]

    def fault(kind: str, message: str) -> None:
        faults.append(RowFault(kind, name, f"{where}: {message}"))

    def number(column: str, default: float, low: float, high: float, allowed: str) -> float:
        text = cells.get(column, "")
        if not text:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            fault("not_a_number", f"{column} is {text[:40]!r}; write {allowed}")
            return default
        return value

    for column in REQUIRED:
        if not cells[column]:
            fault("unreadable", f"{column} is empty; fill it in")
    names = [c.name for c in bench.channels]
    if cells["channel"] and cells["channel"] not in names:
        near = get_close_matches(cells["channel"], names, 1)
        fault(
            "unknown_channel",
            f"channel {cells['channel'][:40]!r} is not in bench.toml; "
            + (
                f"did you mean {near[0]!r}?"
                if near
                else f"use one of {', '.join(names)}, or add a [[channel]]"
            ),
        )
    plane = number("plane_mm", bench.distance_mm, -1e4, 1e4, "a distance in mm, from -10000 to 10000")
    exposure = number("exposure_ms", 1.0, 1e-6, 1e7, "an exposure in ms, above 0")
    time = number("time_s", float(index), -1e9, 1e9, "a time in seconds")
    files: list[Path] = []
    for column in ("phase", "image"):
        relative = cells[column].replace("\\", "/")
        if relative[:1] == "/" or ".." in relative.split("/") or ":" in relative or "\0" in relative:
            fault(
                "missing_file",
                f"{column} {relative[:80]!r} is not inside the set; "
                "copy the file into the folder and give its path from there",
            )
            continue
        files.append(set_files.folder / relative)
        if relative and not set_files.has(relative):
            fault(
                "missing_file",
                f"{column} {relative[:80]!r} is not there; put the file back or remove the row",
            )
    if faults:
        return None, faults
    extra = {column: text for column, text in cells.items() if column not in KNOWN}
    return Capture(
        name,
        cells["channel"],
        plane,
        cells.get("pattern") or name,
        files[0],
        files[1],
        exposure,
        time,
        extra,
        cells.get("bracket", ""),
    ), faults
