"""Captures that could be taken next: patterns of every kind in each colour and plane, at several exposures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.acquire import EXPOSURES_MS
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.patterns import PATTERN_KINDS, Gray, pattern_of_kind

EXPOSURES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # of what is usual for the colour
TURNS = 2  # patterns of each kind in each colour and plane, at least
MANY_SCENES = 4  # colours and planes from which on one of each kind is enough
PICTURE = "smooth_picture"  # whose computation says whether a plane is in reach
LARGE = 640 * 480  # panel pixels, beyond which every second kind is left out: each takes long to predict


@dataclass(frozen=True)
class PossibleCapture:
    """A pattern that could be shown in one colour and plane.

    Attributes
    ----------
    channel : str
    plane_mm : float, mm
    kind : str
        The family of the pattern.
    gray : uint8 array [H, W]
    exposures_ms : tuple of float, ms
        That the camera could take it with.
    usual : int
        Place of the usual one among these.
    """

    channel: str
    plane_mm: float
    kind: str
    gray: Gray
    exposures_ms: tuple[float, ...]
    usual: int

    @property
    def scene(self) -> tuple[str, float]:
        """Its colour and plane."""
        return self.channel, self.plane_mm


def possible_captures(
    captures: CaptureSet,
    planes_mm: Sequence[float],
    count: int,
    seed: int = 0,
    limits_ms: tuple[float, float] = EXPOSURES_MS,
) -> list[PossibleCapture]:
    """Captures that could be taken next; patterns that the set shows already in that colour and plane are left out.

    Parameters
    ----------
    captures : CaptureSet
        What there is.
    planes_mm : sequence of float, mm
        In reach of the camera; planes that are out of the patterns' reach are left out.
    count : int
        How many different patterns are needed at least.
    seed : int
        Of the random patterns.
    limits_ms : (float, float), ms
        The shortest and the longest exposure.

    Raises
    ------
    InputError
        Where all planes are too far for a pattern to be computed.
    """
    bench = captures.bench
    scenes = [(c.name, float(p)) for p in dict.fromkeys(planes_mm) for c in bench.channels]
    kinds = PATTERN_KINDS if bench.panel.width * bench.panel.height <= LARGE else PATTERN_KINDS[::2]
    turns = max(TURNS if len(scenes) < MANY_SCENES else 1, 1 + count // (len(scenes) * len(kinds)))
    found = []
    for channel, plane in scenes:
        if not _in_reach(bench, channel, plane):
            continue
        usual = captures.usual_exposure_ms(channel)
        exposures = tuple(float(f"{usual * f:.4g}") for f in EXPOSURES)
        exposures = tuple(e for e in exposures if limits_ms[0] <= e <= limits_ms[1]) or (usual,)
        place = int(np.argmin([abs(e - usual) for e in exposures]))
        here = [c for c in captures.captures if (c.channel, c.plane_mm) == (channel, plane)]
        shown = {captures.gray(c).tobytes() for c in here}
        first = _turns_taken(here)
        for kind in kinds:
            for turn in range(first[kind], first[kind] + turns):
                gray = pattern_of_kind(bench, channel, plane, kind, turn, seed).gray
                if gray.tobytes() not in shown:
                    shown.add(gray.tobytes())
                    found.append(PossibleCapture(channel, plane, kind, gray, exposures, place))
    if not found:
        planes = ", ".join(f"{p:g}" for p in dict.fromkeys(planes_mm))
        raise InputError(f"no pattern can be computed for the planes {planes} mm: give nearer --planes")
    return found


def _in_reach(bench: Bench, channel: str, plane_mm: float) -> bool:
    """Whether pictures can be computed for a plane."""
    try:
        pattern_of_kind(bench, channel, plane_mm, PICTURE, 0)
    except InputError:
        return False
    return True


def _turns_taken(captures: Sequence[Capture]) -> Counter[str]:
    """How many patterns of each kind were shown, as sets that hololoop took say in their column `kind`."""
    kinds = {c.pattern: c.extra.get("kind", "") for c in captures}
    return Counter(kinds.values())
