"""Captures beyond those of a set: patterns written ready to show, and a copy of the set with further captures."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from runtime.bundle.whole_files import whole_file
from trainer.captures.acquire import Headset
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_table import Capture
from trainer.captures.capture_writer import COLUMNS
from trainer.captures.patterns import Gray

PATTERN_COLUMNS = (
    "capture",
    "channel",
    "plane_mm",
    "pattern",
    "phase",
    "exposure_ms",
    "kind",
    "expected_gain",
    "why",
)


def new_ids(captures: CaptureSet, count: int) -> list[str]:
    """Ids that no capture and no pattern of a set has: next-000 and so on."""
    taken = {c.capture for c in captures.captures} | {c.pattern for c in captures.captures}
    found: list[str] = []
    number = 0
    while len(found) < count:
        name = f"next-{number:03d}"
        if name not in taken:
            found.append(name)
        number += 1
    return found


def write_patterns(folder: Path, rows: Iterable[tuple[Mapping[str, Any], Gray]]) -> None:
    """Write patterns and patterns.csv, which has the columns of captures.csv but for image and time.

    Parameters
    ----------
    folder : Path
        It must be there.
    rows : iterable of (mapping, uint8 array [H, W])
        The values of PATTERN_COLUMNS, and the gray levels.
    """
    (folder / "phase").mkdir()
    written = []
    for row, gray in rows:
        Image.fromarray(gray).save(folder / row["phase"], compress_level=3)
        written.append({column: row[column] for column in PATTERN_COLUMNS})
    _write_table(folder / "patterns.csv", PATTERN_COLUMNS, written)


def copy_captures(captures: CaptureSet, folder: Path) -> CaptureSet:
    """Copy a set's bench, table, patterns and images into a folder, which must be there and empty.

    Raises
    ------
    OSError
        Where a file cannot be copied.
    """
    for name in ("phase", "image"):
        (folder / name).mkdir()
    shutil.copyfile(captures.folder / "bench.toml", folder / "bench.toml")
    copies: dict[Path, str] = {}
    rows = []
    for k, c in enumerate(captures.captures):
        for kind, path in (("phase", c.phase), ("image", c.image)):
            if path not in copies:
                copies[path] = f"{kind}/{k:04d}.png"
                shutil.copyfile(path, folder / copies[path])
        rows.append(_row(c, copies[c.phase], copies[c.image]))
    _write_captures(folder, rows)
    return read_captures(folder)


def take_further(
    headset: Headset,
    captures: CaptureSet,
    chosen: Sequence[tuple[Mapping[str, Any], Gray]],
) -> CaptureSet:
    """Show patterns on a bench, capture them, and append them to a set.

    Parameters
    ----------
    headset : Headset
    captures : CaptureSet
        Its table is replaced after each.
    chosen : sequence of (mapping, uint8 array [H, W])
        Keys capture, pattern, channel, plane_mm, exposure_ms; others become columns. And the gray levels.

    Returns
    -------
    CaptureSet
        With the further captures.

    Raises
    ------
    InputError
        For a plane that the bench does not reach.
    DeviceError
        Where a device fails.
    """
    folder = captures.folder
    rows = [_row(c, _inside(c.phase, folder), _inside(c.image, folder)) for c in captures.captures]
    began, last = headset.time_s, max(c.time_s for c in captures.captures)
    for one, gray in chosen:
        headset.move_to_plane(one["plane_mm"])
        headset.lasers.off()
        headset.lasers.set_power(one["channel"], 1.0)
        try:
            headset.camera.exposure_ms = one["exposure_ms"]
            headset.panel.show(gray)
            time = last + 1.0 + headset.time_s - began
            counts: np.ndarray = headset.camera.capture()
        finally:
            headset.lasers.off()
        phase, image = (f"{kind}/{len(rows):04d}.png" for kind in ("phase", "image"))
        Image.fromarray(gray).save(folder / phase, compress_level=3)
        Image.fromarray(counts.astype(np.uint16)).save(folder / image, compress_level=1)
        simulated = "yes" if headset.simulated else "no"
        rows.append({**one, "phase": phase, "image": image, "time_s": round(time, 6), "simulated": simulated})
        _write_captures(folder, rows)
    return read_captures(folder)


def planes_in_reach(headset: Headset, planes_mm: Iterable[float]) -> list[float]:
    """Those of the planes, mm, to which the bench's camera can be focused."""
    from firmware_iface.errors import InputError

    found = []
    for plane in dict.fromkeys(planes_mm):
        try:
            headset.move_to_plane(plane)
        except InputError:
            continue
        found.append(plane)
    return found


def _row(c: Capture, phase: str, image: str) -> dict[str, Any]:
    return {
        "capture": c.capture,
        "channel": c.channel,
        "plane_mm": repr(c.plane_mm),
        "pattern": c.pattern,
        "phase": phase,
        "image": image,
        "exposure_ms": repr(c.exposure_ms),
        "time_s": repr(c.time_s),
        **c.extra,
    }


def _inside(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()


def _write_captures(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    columns = tuple(dict.fromkeys((*COLUMNS, *(column for row in rows for column in row))))
    _write_table(folder / "captures.csv", columns, rows)


def _write_table(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    with whole_file(path, "w") as stream:
        table = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
