"""Where a solve begins: with a network's phase, with double phase, or with the frame before, moved as its content."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.lightpath.light_path import LightPath
from runtime.solver.double_phase import Start
from runtime.solver.drive_range import DriveRange
from runtime.solver.initialiser import Initialiser
from runtime.solver.objective import Objective
from runtime.solver.video_motion import renewed, shifted

Array = Any


class FirstPhases:
    """First phases for all colours of an objective, in place.

    Parameters
    ----------
    objective : Objective
    stacks : list of list of LightPath
        Colours of planes; a start is for the first plane.
    drives : list of DriveRange
        Of the colours.
    initialiser : bytes or None
        A network in ONNX from a target's amplitude to a first phase.

    Raises
    ------
    InputError
        For a network that does not fit the panel.
    """

    def __init__(
        self,
        objective: Objective,
        stacks: Sequence[Sequence[LightPath]],
        drives: Sequence[DriveRange],
        initialiser: bytes | None,
    ) -> None:
        self.backend, self.drives, self.shape = objective.backend, drives, objective.shape[1:]
        self.starts = [
            Start(objective, stack[0], c, drive.gapless and initialiser is None)
            for c, (stack, drive) in enumerate(zip(stacks, drives, strict=True))
        ]
        self.initialiser = None if initialiser is None else Initialiser(initialiser, self.shape)
        self.amplitude = np.zeros(self.shape, stacks[0][0].response.dtype)

    def cold(self, targets: np.ndarray, phases: Array) -> None:
        """Fill `phases` (rad) [C, H, W] from targets [C, K, H, W] alone, not from the picture before."""
        for c, (drive, start, phase) in enumerate(zip(self.drives, self.starts, phases, strict=True)):
            np.multiply(
                targets[c, 0], 1 / float(np.mean(targets[c, 0], dtype=np.float64)), out=self.amplitude
            )
            np.sqrt(self.amplitude, out=self.amplitude)
            if self.initialiser is not None:
                phase[...] = self.backend.xp.asarray(self.initialiser.phase(self.amplitude))
            elif drive.gapless:
                start.double_phase(self.amplitude, phase)
            else:
                start.flat_phase(self.amplitude, phase)
            if drive.bounded:
                phase[...] = self.backend.xp.asarray(drive.held(self.backend.to_host(phase)))

    def warm(
        self, before: Array, motion: tuple[int, int], targets: np.ndarray, phases: Array, room: Array
    ) -> None:
        """Fill `phases` with those of the frame before, moved as its content has moved.

        Parameters
        ----------
        before : float array [C, H, W], rad
            Phases of the frame before.
        motion : (int, int), pixels
            Down, right.
        targets : array [C, K, H, W]
            Of this frame: where content comes in, the start is cold.
        phases, room : float array [C, H, W], rad
            The result, and room to work in.
        """
        shifted(before, motion, phases)
        if any(motion):
            self.cold(targets, room)
            for phase, fresh, start in zip(phases, room, self.starts, strict=True):
                for part in renewed(motion, start.edges, self.shape):
                    phase[part] = fresh[part]
