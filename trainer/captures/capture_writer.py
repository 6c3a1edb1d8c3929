"""Writes a capture set one capture at a time; the folder appears whole or not at all."""

from __future__ import annotations

import csv
import math
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from PIL import Image

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench, bench_tables, read_bench

COLUMNS = ("capture", "channel", "plane_mm", "pattern", "phase", "image", "exposure_ms", "time_s")


class CaptureWriter:
    """A context manager that fills a capture set.

        with CaptureWriter(folder, bench) as writer:
            writer.add(gray=gray, counts=counts, channel="green", pattern="p0", temperature_c=21.5)

    The set is built in a temporary folder next to its destination and renamed when the block ends. An
    exception leaves nothing behind. At least one capture is needed.
    """

    def __init__(self, folder: Path | str, bench: Bench | Mapping[str, Any]) -> None:
        """Make the temporary folder.

        Parameters
        ----------
        folder : path
            Where the set is written.
        bench : Bench or mapping
            A bench, or the tables of bench.toml.

        Raises
        ------
        InputError
            If the folder is not empty or cannot be made, or the bench is not valid.
        """
        self.folder = Path(folder).absolute()
        self.tables = dict(bench_tables(bench) if isinstance(bench, Bench) else bench)
        self.bench = read_bench(self.tables)
        self._rows: list[dict[str, str]] = []
        self._ids: set[str] = set()
        self._refuse_existing()
        try:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            self._work = Path(tempfile.mkdtemp(prefix=f".{self.folder.name}.", dir=self.folder.parent))
            (self._work / "phase").mkdir()
            (self._work / "image").mkdir()
            (self._work / "bench.toml").write_text(_toml_text(self.tables), encoding="utf-8")
        except OSError as error:
            raise InputError(
                f"{self.folder} cannot be made ({error.strerror}): choose another folder"
            ) from None

    def add(
        self,
        gray: np.ndarray,
        counts: np.ndarray,
        channel: str,
        capture: str | None = None,
        plane_mm: float | None = None,
        pattern: str | None = None,
        exposure_ms: float = 1.0,
        time_s: float | None = None,
        **extra: Any,
    ) -> str:
        """Write one capture.

        Parameters
        ----------
        gray : uint8 array [H, W]
            Gray levels sent to the panel.
        counts : uint16 array [h, w], raw camera counts
        channel : str
        capture : str, optional
            Its id; by default its number.
        plane_mm : float, mm, optional
            By default the bench's distance.
        pattern : str, optional
            By default the capture's id: a pattern of its own.
        exposure_ms : float, ms
        time_s : float, s, optional
            From the first capture; by default the capture's number.
        **extra
            Further columns, written as text.

        Returns
        -------
        str
            The capture's id.

        Raises
        ------
        InputError
            If an array has the wrong shape, type or range, the id is used already, or the channel is unknown.
        """
        index = len(self._rows)
        name = f"{index:04d}" if capture is None else str(capture)
        if name in self._ids:
            raise InputError(f"capture {name} is written twice: give every capture its own id")
        self.bench.channel(channel)
        plane = self.bench.distance_mm if plane_mm is None else float(plane_mm)
        time = float(index) if time_s is None else float(time_s)
        for column, value in (("plane_mm", plane), ("exposure_ms", exposure_ms), ("time_s", time)):
            if not math.isfinite(value):
                raise InputError(f"capture {name} has {column} = {value}: give a finite number")
        row = {
            "capture": name,
            "channel": channel,
            "plane_mm": repr(plane),
            "pattern": pattern or name,
            "phase": f"phase/{index:04d}.png",
            "image": f"image/{index:04d}.png",
            "exposure_ms": repr(float(exposure_ms)),
            "time_s": repr(time),
        }
        row |= {column: str(value) for column, value in extra.items()}
        for column, text in row.items():
            if column in COLUMNS[:4] and not (text.strip() == text != ""):
                raise InputError(
                    f"capture {name} has {column} = {text!r}: give text without spaces around it"
                )
        gray = _whole(gray, self.bench.panel.shape, 255, f"the pattern of capture {name}")
        counts = _whole(
            counts, self.bench.camera.shape, self.bench.camera.saturation, f"the image of capture {name}"
        )
        try:
            Image.fromarray(gray.astype(np.uint8)).save(self._work / row["phase"], compress_level=3)
            Image.fromarray(counts.astype(np.uint16)).save(self._work / row["image"], compress_level=1)
        except OSError as error:
            raise InputError(
                f"capture {name} cannot be written ({error.strerror}): make room on the disk"
            ) from None
        self._ids.add(name)
        self._rows.append(row)
        return name

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            shutil.rmtree(self._work, ignore_errors=True)

    def _finish(self) -> None:
        if not self._rows:
            raise InputError(f"{self.folder} would have no captures: add at least one")
        columns = list(dict.fromkeys((*COLUMNS, *(column for row in self._rows for column in row))))
        with (self._work / "captures.csv").open("w", encoding="utf-8", newline="") as stream:
            table = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
            table.writeheader()
            table.writerows(self._rows)
            stream.flush()
            os.fsync(stream.fileno())
        self._refuse_existing()
        mask = os.umask(0)
        os.umask(mask)
        self._work.chmod(0o777 & ~mask)
        if self.folder.is_dir():
            self.folder.rmdir()
        self._work.rename(self.folder)

    def _refuse_existing(self) -> None:
        path = self.folder
        if (path.exists() or path.is_symlink()) and not (path.is_dir() and not any(path.iterdir())):
            raise InputError(
                f"{path} exists already and is not empty: choose another folder, or remove it first"
            )


def _toml_text(tables: Mapping[str, Any]) -> str:
    """TOML for the tables of a bench: plain values, then one table for each mapping, lists of tables as [[...]]."""
    lines = [
        f"{key} = {_literal(value)}"
        for key, value in tables.items()
        if not isinstance(value, Mapping) and key != "channel"
    ]
    for key, value in tables.items():
        if isinstance(value, Mapping):
            lines += ["", f"[{key}]", *(f"{k} = {_literal(v)}" for k, v in value.items())]
        elif key == "channel":
            for row in value:
                lines += ["", f"[[{key}]]", *(f"{k} = {_literal(v)}" for k, v in row.items())]
    return "\n".join(lines) + "\n"


def _literal(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, str):
        text = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in text) + '"'
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_literal(v) for v in value) + "]"
    return repr(value)


def _whole(array: Any, shape: tuple[int, int], top: int, what: str) -> np.ndarray:
    """A whole-number array of that shape with values from 0 to top."""
    array = np.asarray(array)
    if array.shape != shape:
        raise InputError(f"{what} has shape {array.shape}, but the bench says {shape}: give [row, column]")
    if array.dtype.kind not in "ui" or array.min() < 0 or array.max() > top:
        raise InputError(f"{what} has values outside whole numbers from 0 to {top}: round and clip it first")
    return array
