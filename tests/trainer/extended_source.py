"""A small bench whose source has an extent, which at one plane is a camera's blur, and effects to tell apart."""

from __future__ import annotations

from pathlib import Path

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import CaptureSet, read_captures

FEW = ("spatial_coherence", "sensor_blur", "zero_order", "crosstalk")


def extended_source(folder: Path) -> Path:
    """The bench's file."""
    return bench_file(folder, 'kind = "spatial_coherence"', width=96, height=64, distance_mm=8)


def captured(bench: Path) -> CaptureSet:
    """Its captures of four patterns, in a folder beside the file."""
    acquire_from(str(bench), bench.parent / "captures", patterns=4)
    return read_captures(bench.parent / "captures")
