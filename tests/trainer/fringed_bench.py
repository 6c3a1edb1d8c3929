"""A small bench whose one defect no effect of the catalogue names, and captures of it."""

from __future__ import annotations

from pathlib import Path

from firmware_iface.virtual import BenchDescription, VirtualHeadset, make_defect
from firmware_iface.virtual.bench_description import ChannelDescription
from trainer.captures.acquire import acquire_captures
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.open_bench import nominal_bench

SHAPE = (48, 64)
COLOURS = (ChannelDescription("red", 638.0), ChannelDescription("green", 520.0))


def fringed(colours: bool = False, kind: str = "fringes") -> VirtualHeadset:
    """A headset of SHAPE whose picture is crossed by bent fringes (or has another defect)."""
    plain = BenchDescription("taught", defects=(make_defect(kind),))
    if colours:
        plain = BenchDescription("taught", channels=COLOURS, defects=(make_defect(kind),))
    return VirtualHeadset(plain.resized(*SHAPE, 6.0), seed=3)


def known(headset: VirtualHeadset) -> Bench:
    """What a person would write down of it."""
    return nominal_bench(headset)


def captured(folder: Path, patterns: int = 18, colours: bool = False) -> CaptureSet:
    """A capture set of it."""
    headset = fringed(colours)
    acquire_captures(headset, known(headset), folder, patterns=patterns)
    return read_captures(folder)
