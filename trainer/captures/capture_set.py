"""Capture sets: a folder of patterns and camera pictures.

A set holds ``bench.toml`` (what is known before anything is measured), ``captures.csv`` (one row for each picture),
8-bit panel patterns and 16-bit raw camera pictures. Arrays are [row, column]; counts are raw camera counts.
Pictures are read only when needed, so a set may be larger than memory. Anything wrong with a set is an
`InputError` of one sentence.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench, Camera, read_bench
from trainer.captures.brackets import Measured, bracket_faults, merged, one_capture_each
from trainer.captures.camera_noise import compare_repeats, noise_variance
from trainer.captures.camera_numbers import MEASURED_PAIRS, camera_by_repeats, repeated_pairs
from trainer.captures.capture_table import Capture, scan_rows
from trainer.captures.equal_patterns import one_name_each
from trainer.captures.png_reader import read_picture


@dataclass(frozen=True)
class CaptureSet:
    """A capture set that can be read; pictures are read from disk at each call, and only workers keep some of them.

    Attributes
    ----------
    folder : Path
    bench : Bench
    captures : tuple of Capture
    """

    folder: Path
    bench: Bench
    captures: tuple[Capture, ...]

    def __len__(self) -> int:
        return len(self.captures)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that have captures, in the bench's order."""
        used = {c.channel for c in self.captures}
        return tuple(c.name for c in self.bench.channels if c.name in used)

    @property
    def planes(self) -> tuple[float, ...]:
        """Distances that have captures, mm, ascending."""
        return tuple(sorted({c.plane_mm for c in self.captures}))

    def usual_exposure_ms(self, channel: str) -> float:
        """Median exposure of a colour's captures, or of all where there are none of this colour."""
        own = [c.exposure_ms for c in self.captures if c.channel == channel]
        return float(np.median(own or [c.exposure_ms for c in self.captures]))

    def gray(self, capture: Capture) -> np.ndarray:
        """Gray levels sent to the panel.

        Returns
        -------
        uint8 array [H, W]

        Raises
        ------
        InputError
            If the file is missing, damaged, not 8-bit gray, or not of the panel's size.
        """
        what = f"the pattern of capture {capture.capture}"
        return read_picture(capture.phase, self.bench.panel.shape, 8, what)

    def counts(self, capture: Capture) -> np.ndarray:
        """Raw camera counts; of a bracket, those of its shortest exposure.

        Returns
        -------
        uint16 array [h, w]

        Raises
        ------
        InputError
            If the file is missing, damaged, of the wrong kind or size, or holds counts above the bench's bit depth.
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

    def measured(self, capture: Capture) -> Measured:
        """Counts above black, where they can be used, and the variance of their noise.

        The frames of a bracket are merged.

        Raises
        ------
        InputError
            As `counts` does.
        """
        pictures = [self.counts(row) for row in capture.rows]
        if capture.frames:
            return merged(pictures, [row.exposure_ms for row in capture.rows], self.noise_camera())
        camera, counts = self.bench.camera, pictures[0]
        signal = counts.astype(np.float32) - np.float32(camera.black_level)
        return Measured(signal, counts < camera.saturation, self.noise_variance(signal))

    def signal(self, capture: Capture) -> tuple[np.ndarray, np.ndarray]:
        """Counts above black, and where they can be used, as from `measured`.

        Returns
        -------
        float32 array [h, w], counts above black
        bool array [h, w]
            True where the pixel is not saturated.

        Raises
        ------
        InputError
            As `counts` does.
        """
        measured = self.measured(capture)
        return measured.signal, measured.valid

    def noise_camera(self) -> Camera:
        """The bench's camera with the full well and read noise that count.

        Those that bench.toml states; those that repeated captures show where it is silent or clearly wrong.
        """
        pictures = tuple((a.image, b.image) for a, b in repeated_pairs(self.captures)[:MEASURED_PAIRS])
        return _noise_camera(
            self.bench.camera, pictures, tuple(_changed(path) for pair in pictures for path in pair)
        )

    def noise_variance(self, signal: Any) -> Any:
        """Variance of the camera's noise, counts^2, of a signal of counts above black; in the signal's shape."""
        return noise_variance(signal, self.noise_camera())

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

        Raises
        ------
        InputError
            When a file cannot be read.
        """
        digest = hashlib.sha256()
        files = [self.folder / "bench.toml", self.folder / "captures.csv"]
        files += [p for c in self.captures for row in c.rows for p in (row.phase, row.image)]
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
    """The capture set in a folder; its pictures must exist but are not decoded.

    Captures of one channel that show the same gray levels are of one pattern, whatever captures.csv calls them. Rows of
    one exposure bracket are one capture.

    Parameters
    ----------
    folder : path

    Returns
    -------
    CaptureSet

    Raises
    ------
    InputError
        At the first thing that is wrong with bench.toml or captures.csv, or for a missing file.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a capture set, with bench.toml and captures.csv")
    bench = read_bench(folder / "bench.toml")
    rows, faults = scan_rows(folder, bench)
    faults = faults or bracket_faults(rows)
    if faults:
        raise InputError(faults[0].message)
    return CaptureSet(folder, bench, tuple(one_capture_each(one_name_each(rows))))


@lru_cache(maxsize=8)
def _noise_camera(
    camera: Camera, pictures: tuple[tuple[Path, Path], ...], changed: tuple[int, ...]
) -> Camera:
    depth = 16 if camera.bit_depth > 8 else 0
    try:
        pairs = [[read_picture(path, camera.shape, depth, "the image") for path in pair] for pair in pictures]
    except InputError:  # a picture that cannot be read: whoever uses it reports that
        return camera
    repeats = (compare_repeats(first, second, camera) for first, second in pairs)
    return camera_by_repeats(camera, [r for r in repeats if r is not None])


def _changed(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def opened(folder: Path) -> CaptureSet:
    """The capture set of a folder, read once in a process, and again when its tables have changed."""
    return _opened(folder, *((folder / name).stat().st_mtime_ns for name in ("bench.toml", "captures.csv")))


@lru_cache(maxsize=4)
def _opened(folder: Path, *changed: int) -> CaptureSet:
    return read_captures(folder)


def chosen(captures: CaptureSet, ids: Sequence[str]) -> list[Capture]:
    """Captures by id, in the order of the set."""
    wanted = set(ids)
    return [c for c in captures.captures if c.capture in wanted]
