"""Capture sets: a folder of patterns and camera pictures, its reader and its writer.

A set holds ``bench.toml`` (what is known before anything is measured), ``captures.csv`` (one row a capture),
8-bit panel patterns and 16-bit raw camera pictures. Arrays are [row, column]; counts are raw camera counts.
Pictures are read when asked for, so that a set may be larger than memory. Whatever is wrong with a set is an
`InputError` of one sentence.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench, Camera, Channel, Iris, Panel, bench_tables, read_bench
from trainer.captures.capture_writer import CaptureWriter, write_captures
from trainer.captures.png_reader import PictureError, read_picture, reason

__all__ = [
    "Bench",
    "Camera",
    "Capture",
    "CaptureSet",
    "CaptureWriter",
    "Channel",
    "Iris",
    "Panel",
    "PictureError",
    "RowFault",
    "bench_tables",
    "read_bench",
    "read_captures",
    "read_picture",
    "scan_rows",
    "write_captures",
]

REQUIRED = ("capture", "channel", "phase", "image")
KNOWN = (*REQUIRED, "plane_mm", "pattern", "exposure_ms", "time_s")


@dataclass(frozen=True)
class Capture:
    """One row of captures.csv.

    plane_mm : float, mm, panel to image plane as asked for
    phase, image : absolute paths of the panel's pattern and of the camera's picture
    exposure_ms : float, ms
    time_s : float, seconds from the first capture (the row's number where the set does not say)
    extra : the columns that this reader does not know, as text
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


@dataclass(frozen=True)
class RowFault:
    """A thing that is wrong with captures.csv: its kind, the capture's id ("" for the file), one sentence."""

    kind: str
    capture: str
    message: str


@dataclass(frozen=True)
class CaptureSet:
    """A readable capture set; pictures are read from disk at each call and nothing is kept."""

    folder: Path
    bench: Bench
    captures: tuple[Capture, ...]

    def __len__(self) -> int:
        return len(self.captures)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that have captures, in the bench's order."""
        seen = {c.channel for c in self.captures}
        return tuple(c.name for c in self.bench.channels if c.name in seen)

    @property
    def planes(self) -> tuple[float, ...]:
        """Distances that have captures, mm, ascending."""
        return tuple(sorted({c.plane_mm for c in self.captures}))

    def select(self, captures: Iterable[Capture]) -> CaptureSet:
        """The same bench with only these captures."""
        return replace(self, captures=tuple(captures))

    def gray(self, capture: Capture) -> np.ndarray:
        """Gray levels sent to the panel, uint8 [H, W].

        Raises InputError if the file is missing, damaged, not 8-bit gray, or not of the panel's size.
        """
        what = f"the pattern of capture {capture.capture}"
        return read_picture(capture.phase, self.bench.panel.shape, 8, what)

    def counts(self, capture: Capture) -> np.ndarray:
        """Raw camera counts, uint16 [h, w].

        Raises InputError if the file is missing, damaged, of the wrong kind or size, or holds counts that the
        bench's bit depth does not reach.
        """
        camera = self.bench.camera
        what = f"the image of capture {capture.capture}"
        counts = read_picture(capture.image, camera.shape, 16 if camera.bit_depth > 8 else 0, what)
        top = int(counts.max())
        if top > camera.saturation:
            raise InputError(
                f"{what} has counts up to {top}, but camera.bit_depth = {camera.bit_depth} ends at "
                f"{camera.saturation}: shift the counts down if they sit in the top bits, "
                "or correct bit_depth"
            )
        return counts

    def signal(self, capture: Capture) -> tuple[np.ndarray, np.ndarray]:
        """Counts above black, float32 [h, w], and where they mean something (not saturated), bool [h, w].

        Raises InputError as `counts` does.
        """
        counts = self.counts(capture)
        return counts.astype(np.float32) - np.float32(
            self.bench.camera.black_level
        ), counts < self.bench.camera.saturation

    def noise_variance(self, signal: Any) -> Any:
        """Variance that the camera's noise gives a signal of counts above black, counts^2, same shape.

        Shot noise, read noise and the rounding to whole counts.
        """
        gain = self.bench.camera.counts_per_electron
        floor = (self.bench.camera.read_noise_e * gain) ** 2 + 1 / 12
        return np.maximum(signal, 0) * gain + floor

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        planes = ", ".join(f"{z:g} mm" for z in self.planes)
        rows = (
            ("folder", str(self.folder)),
            ("bench", self.bench.name),
            ("captures", str(len(self))),
            ("channels", ", ".join(self.channels)),
            ("planes", planes),
            ("panel", f"{self.bench.panel.height} x {self.bench.panel.width}"),
        )
        return "<table>" + "".join(f"<tr><th>{k}</th><td>{escape(v)}</td></tr>" for k, v in rows) + "</table>"

    def content_hash(self) -> str:
        """SHA-256, hex, over bench.toml, captures.csv, and the ids and files of this selection.

        Raises InputError when a file cannot be read.
        """
        digest = hashlib.sha256()
        files = [self.folder / "bench.toml", self.folder / "captures.csv"]
        files += [p for c in self.captures for p in (c.phase, c.image)]
        digest.update("\n".join(c.capture for c in self.captures).encode())
        for path in dict.fromkeys(files):
            try:
                name = Path(os.path.relpath(path, self.folder)).as_posix()
                digest.update(f"\n{name}\n{path.stat().st_size}\n".encode())
                with path.open("rb") as stream:
                    while block := stream.read(1 << 20):
                        digest.update(block)
            except OSError as error:
                raise InputError(f"{path} cannot be read ({error.strerror}): put the file back") from None
        return digest.hexdigest()


def read_captures(folder: Path | str) -> CaptureSet:
    """The capture set in a folder; its pictures are looked for but not opened.

    Raises InputError at the first thing that is wrong with bench.toml or captures.csv, or a missing file.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a capture set, with bench.toml and captures.csv")
    bench = read_bench(folder / "bench.toml")
    captures, faults = scan_rows(folder, bench)
    if faults:
        raise InputError(faults[0].message)
    return CaptureSet(folder, bench, tuple(captures))


def scan_rows(folder: Path, bench: Bench) -> tuple[list[Capture], list[RowFault]]:
    """All usable rows of a folder's captures.csv, and everything that is wrong with the file; never raises.

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
                "a capture set needs a captures.csv with one row a capture",
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
    seen: set[str] = set()
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
                    f"{len(header)}: put the row right, with quotes around text with commas",
                )
            )
            continue
        capture, wrong = _row(files, bench, cells, where, len(captures))
        if name in seen:
            wrong.insert(
                0,
                RowFault(
                    "duplicate",
                    name,
                    f"{where} repeats the id of an earlier row: give every capture its own id",
                ),
            )
        seen.add(name)
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
        return RowFault("too_few", "", f"{path} has no captures: add one row a capture")
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
                f"{column} {relative[:80]!r} is not there; put the file back or take the row out",
            )
    if faults:
        return None, faults
    extra = {column: text for column, text in cells.items() if column not in KNOWN}
    return Capture(
        name, cells["channel"], plane, cells.get("pattern") or name, files[0], files[1], exposure, time, extra
    ), faults


def opened(folder: Path) -> CaptureSet:
    """The capture set of a folder, read once a process, and again when its tables have changed."""
    return _opened(folder, *((folder / name).stat().st_mtime_ns for name in ("bench.toml", "captures.csv")))


@lru_cache(maxsize=4)
def _opened(folder: Path, *changed: int) -> CaptureSet:
    return read_captures(folder)


def chosen(captures: CaptureSet, ids: Sequence[str]) -> list[Capture]:
    """Captures by id, in the order of the set."""
    wanted = set(ids)
    return [c for c in captures.captures if c.capture in wanted]
