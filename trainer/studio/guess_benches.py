"""Simulated benches to guess at: what is hidden in one follows from its kind and number, and is not shown."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from firmware_iface.virtual import CATALOGUE_KINDS, BenchDescription, VirtualHeadset, make_defect
from firmware_iface.virtual.bench_description import ChannelDescription
from runtime.bundle.whole_files import whole_file
from runtime.headset.followed_camera import FollowedCamera
from trainer.captures.acquire import acquire_captures
from trainer.captures.block_means import blocks
from trainer.captures.open_bench import nominal_bench
from trainer.studio.jobs import Say

NOTE = "guess.json"  # in the capture set: the bench's kind and number
KINDS = {
    "One thing is wrong": "one",
    "Two things are wrong": "two",
    "Three things are wrong": "three",
    "Three colours, one thing is wrong": "colours",
    "Something that no catalogue names": "outside",
    "Perhaps nothing is wrong": "perhaps",
}
PATTERNS = 9
ROWS, COLUMNS, DISTANCE_MM = 144, 192, 18.0
SHOWN_PX = 192
# On one plane a blur of the camera looks like a source's extent: a guess at one bench must have an answer.
GUESSED = tuple(k for k in CATALOGUE_KINDS if k not in ("temporal_coherence", "spatial_coherence"))


def guess_bench(kind: str, number: int) -> BenchDescription:
    """The bench of a kind and number, with its defects.

    Raises
    ------
    InputError
        For an unknown kind.
    """
    if kind not in KINDS.values():
        raise InputError(f"there is no simulated bench of kind '{kind}': choose one of the list")
    rng = np.random.default_rng([number, list(KINDS.values()).index(kind)])
    count = {"one": 1, "two": 2, "three": 3, "colours": 1, "outside": 0}.get(kind, int(rng.integers(0, 2)))
    names = [str(n) for n in rng.choice(GUESSED, count, replace=False)]
    if kind == "outside":
        names = [str(rng.choice(["specks", "fringes", "stripes"]))]
    bench = BenchDescription(f"guess-{number}", defects=tuple(make_defect(n) for n in names))
    if kind == "colours":
        waves = (("red", 638.0), ("green", 520.0), ("blue", 450.0))
        bench = replace(bench, channels=tuple(ChannelDescription(n, w) for n, w in waves))
    return bench.resized(ROWS, COLUMNS, DISTANCE_MM)


def noted(folder: Path) -> tuple[str, int] | None:
    """Kind and number of the simulated bench that a capture set was taken from; None where it is no guess."""
    try:
        note = json.loads((folder / NOTE).read_text(encoding="utf-8"))
        return str(note["kind"]), int(note["number"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def hidden_in(folder: Path) -> list[str] | None:
    """The defects of the bench that a capture set was taken from, in words; None where it is no guess."""
    note = noted(folder)
    if note is None:
        return None
    return [
        f"{d.kind.replace('_', ' ')}: {(type(d).__doc__ or '').splitlines()[0]}"
        for d in guess_bench(*note).defects
    ]


def capture_guess(say: Say, kind: str, number: int, folder: Path) -> Path:
    """Take a capture set from a simulated bench; each picture is said as ("picture", counts) when it is taken."""
    headset = VirtualHeadset(guess_bench(kind, number), seed=number)
    watched = _WatchedHeadset(headset, lambda counts: say("picture", counts))
    acquire_captures(
        watched,
        nominal_bench(headset),
        folder,
        PATTERNS if kind != "colours" else 6,
        progress=lambda done, what="": say("progress", (done, f"capturing: {what}")),
        seed=number,
    )
    with whole_file(folder / NOTE, "w") as stream:
        json.dump({"kind": kind, "number": number}, stream)
    return folder


@dataclass
class _WatchedHeadset:
    """A headset whose pictures somebody watches, smaller than they are."""

    headset: VirtualHeadset
    watch: Callable[[np.ndarray], None]

    def __post_init__(self) -> None:
        self.camera = FollowedCamera(self.headset.camera, self._tell)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.headset, name)

    def _tell(self, counts: np.ndarray) -> None:
        self.watch(blocks(counts.astype(np.float32), max(1, -(-max(counts.shape) // SHOWN_PX))))
