"""A virtual headset whose defects change from capture to capture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual import BenchDescription, VirtualHeadset
from firmware_iface.virtual.defect_kind import Defect
from trainer.captures.acquire import acquire_captures
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.open_bench import nominal_bench

SHAPE = (72, 96)


class ChangingHeadset(VirtualHeadset):
    """A headset that has other defects at each capture.

    Parameters
    ----------
    defects_at : callable
        `number of captures before -> defects`.
    still : int
        Captures at the beginning, which set the exposure, in which nothing changes yet.
    """

    def __init__(
        self, defects_at: Callable[[int], tuple[Defect, ...]], still: int, shape: tuple[int, int] = SHAPE
    ) -> None:
        self.defects_at, self.still = defects_at, still
        super().__init__(BenchDescription("changing").resized(*shape, 8.0), seed=3)

    def _capture(self) -> NDArray[np.uint16]:
        number = max(0, self.captures - self.still)
        bench = BenchDescription("changing", defects=self.defects_at(number))
        now = VirtualHeadset(bench.resized(*self.panel.shape, 8.0), self.seed)
        now.panel, now.lasers, now.camera = self.panel, self.lasers, self.camera
        now.captures, now.plane_mm = self.captures, self.plane_mm
        counts = VirtualHeadset._capture(now)
        self.captures += 1
        self.time_s = 0.1 * self.captures
        return counts


def captured_while_changing(
    folder: Path, defects_at: Callable[[int], tuple[Defect, ...]], patterns: int = 16
) -> CaptureSet:
    """A capture set of such a headset."""
    headset = ChangingHeadset(defects_at, still=patterns)
    acquire_captures(headset, nominal_bench(headset), folder / "captures", patterns=patterns)
    return read_captures(folder / "captures")
