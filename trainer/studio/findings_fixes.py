"""Findings of the check that a line of bench.toml or captures.csv corrects: the correction, and a copy of the old."""

from __future__ import annotations

import csv
import io
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import tomlkit

from firmware_iface.errors import InputError
from runtime.bundle.whole_files import whole_file
from trainer.captures.problems import Problem

REMOVED_ROWS = (
    "dark",
    "saturated",
    "missing_file",
    "wrong_size",
    "unreadable",
    "not_a_number",
    "no_signal",
    "duplicate",
)


@dataclass(frozen=True)
class Fix:
    """A correction of one file.

    Attributes
    ----------
    what : str
        What it does, for the button.
    path : Path
        The file.
    changed : callable
        The file's new text from its old one.
    """

    what: str
    path: Path
    changed: Callable[[str], str]

    def apply(self) -> Path:
        """Make the correction; returns the copy of the old file.

        Raises
        ------
        InputError
            Where the file is another one by now, or cannot be written.
        """
        old = self.path.read_text(encoding="utf-8-sig")
        new = self.changed(old)
        kept = _free_name(self.path)
        try:
            shutil.copy2(self.path, kept)
        except OSError as error:
            raise InputError(f"{kept} cannot be written ({error.strerror}): nothing was changed") from None
        with whole_file(self.path, "w") as stream:
            stream.write(new)
        return kept


def fix_of(folder: Path, problem: Problem) -> Fix | None:
    """The correction of a finding; None where it is not a line of bench.toml or captures.csv."""
    bench, table = folder / "bench.toml", folder / "captures.csv"
    if problem.kind == "convention":
        found = re.search(r"set phase_sign = (-?1)", problem.message)
        return _set(bench, "panel", {"phase_sign": int(found.group(1))}) if found else None
    if problem.kind == "black_level":
        found = re.search(r"repeated patterns points? to (\d+)", problem.message)
        return _set(bench, "camera", {"black_level": int(found.group(1))}) if found else None
    if problem.kind == "bit_depth":
        found = re.search(r"has counts up to (\d+), but", problem.message)
        depth = next((b for b in (8, 10, 12, 14, 16) if found and int(found.group(1)) < 2**b), None)
        said = re.search(r"write bit_depth = (\d+)", problem.message)
        depth = int(said.group(1)) if said else depth
        return _set(bench, "camera", {"bit_depth": depth}) if depth else None
    if problem.kind == "camera_numbers":
        found = re.search(r"show full_well_e = (\S+) and read_noise_e = ([\d.]+)", problem.message)
        if not found:
            return None
        return _set(
            bench, "camera", {"full_well_e": float(found.group(1)), "read_noise_e": float(found.group(2))}
        )
    if problem.kind == "mismatched":
        found = re.search(r"fits the pattern of capture (\S+) \(", problem.message)
        if not found or not _has_row(table, problem.capture) or not _has_row(table, found.group(1)):
            return None
        pair = (problem.capture, found.group(1))
        what = f"Exchange the images of {pair[0]} and {pair[1]} in captures.csv"
        return Fix(what, table, lambda text: _exchanged(text, pair))
    if problem.kind in REMOVED_ROWS and problem.capture and _has_row(table, problem.capture):
        name = problem.capture
        return Fix(
            f"Remove the row of {name} from captures.csv", table, lambda text: _without_row(text, name)
        )
    return None


def _set(path: Path, table: str, values: Mapping[str, int | float]) -> Fix:
    def changed(text: str) -> str:
        document = tomlkit.parse(text)
        if table not in document:
            raise InputError(f"{path.name} has no table [{table}]: add it")
        for key, value in values.items():
            document[table][key] = value
        return tomlkit.dumps(document)

    words = " and ".join(f"{key} = {value:g}" for key, value in values.items())
    return Fix(f"Set {words} in {path.name}", path, changed)


def _has_row(path: Path, capture: str) -> bool:
    try:
        return _place(path.read_text(encoding="utf-8-sig"), capture) is not None
    except (OSError, ValueError):
        return False


def _place(text: str, capture: str) -> tuple[int, list[str]] | None:
    """Line of a capture's row, and all lines; None where it has none or a row takes several lines."""
    lines = text.splitlines(keepends=True)
    rows = list(csv.reader(io.StringIO(text)))
    if len(rows) != len(lines) or not rows:
        return None
    header = [name.strip() for name in rows[0]]
    if "capture" not in header:
        return None
    column = header.index("capture")
    for k, row in enumerate(rows[1:], 1):
        if len(row) > column and row[column].strip() == capture:
            return k, lines
    return None


def _without_row(text: str, capture: str) -> str:
    found = _place(text, capture)
    if found is None:
        raise InputError(f"captures.csv has no row of {capture} any more: check the captures again")
    line, lines = found
    return "".join(lines[:line] + lines[line + 1 :])


def _exchanged(text: str, captures: tuple[str, str]) -> str:
    """The table with the images of two captures exchanged."""
    rows = list(csv.reader(io.StringIO(text)))
    places = [found[0] for name in captures if (found := _place(text, name)) is not None]
    header = [name.strip() for name in rows[0]] if rows else []
    if len(places) < 2 or "image" not in header:
        raise InputError(
            f"captures.csv has no rows of {' and '.join(captures)} any more: check the captures again"
        )
    column, (one, other) = header.index("image"), places
    rows[one][column], rows[other][column] = rows[other][column], rows[one][column]
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def _free_name(path: Path) -> Path:
    number = 1
    while (kept := path.with_name(f"{path.name}.before-{number}")).exists():
        number += 1
    return kept
