"""Where a solve begins: with a network's phase, with double phase, or with the frame before, moved as its content."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.lightpath.light_path import LightPath
from runtime.solver.block_motion import Part, follow
from runtime.solver.double_phase import BOARDS, Start
from runtime.solver.drive_range import DriveRange
from runtime.solver.initialiser import Initialiser
from runtime.solver.objective import Objective
from runtime.solver.video_motion import renewed, shifted

Array = Any

NOISE = 0.5  # rad, rms: with 0.1 the patterns part too slowly, with 1 the light is no nearer in the end
STRIDE = 0.618  # of the panel's rows: how far a pattern's noise is moved from that of the pattern before


class FirstPhases:
    """First phases for all colours of an objective, in place.

    Several patterns for one picture must differ: equal ones would stay equal. Each but the first gets noise of its own,
    and the descent then goes far. Where there is no time for that, double phase has several patterns that are each as
    good (`soon`): after 10 iterations noise is 1 dB nearer, at the start it is 7 dB farther off.

    Parameters
    ----------
    objective : Objective
    stacks : list of list of LightPath
        Colours of planes; a start is for the first plane.
    drives : list of DriveRange
        Of the patterns, a colour's after one another.
    initialiser : bytes or None
        A network in ONNX from a target's amplitude to a first phase.
    edges_count : bool
        Whether the picture counts to its very edge.

    Raises
    ------
    InputError
        For a network that does not fit the panel.

    Attributes
    ----------
    fits : bool
        Whether the last start was made for the picture that the solver has solved last.
    moved : (int, int), pixels
        How far the pattern's content, and so its chequerboard, has moved since the first start: down, right.
    moves : bool
        Whether the light has the tilt of a picture that moves.
    """

    def __init__(
        self,
        objective: Objective,
        stacks: Sequence[Sequence[LightPath]],
        drives: Sequence[DriveRange],
        initialiser: bytes | None,
        edges_count: bool = True,
    ) -> None:
        self.edges_count = edges_count
        self.backend, self.shape = objective.backend, objective.shape[1:]
        self.frames, self.drives = objective.frames, drives[:: objective.frames]
        self.initialiser = None if initialiser is None else Initialiser(initialiser, self.shape)
        begins = self.initialiser is None or self.initialiser.corrects
        self.starts = [
            Start(objective, stack[0], c, begins, drive.gapless, len(stack))
            for c, (stack, drive) in enumerate(zip(stacks, self.drives, strict=True))
        ]
        self.noise: np.ndarray | None = None
        if self.frames > 1:
            noise = np.random.default_rng(0).normal(scale=NOISE, size=self.shape)
            self.noise = noise.astype(stacks[0][0].response.dtype)
        self.amplitude = objective.backend.xp.zeros(self.shape, stacks[0][0].response.dtype)
        self.made = objective.backend.xp.zeros(objective.shape, stacks[0][0].response.dtype)
        self.on_fresh = objective.backend.xp.zeros_like(self.made[0])
        self.fits = False
        self.moved = 0, 0
        self.tilt(moves=False)

    def cold(self, targets: Array, phases: Array, soon: bool = False) -> None:
        """Fill `phases` (rad), a pattern each, from targets [C, K, H, W] alone, not from the picture before.

        With `soon`, for few iterations, and for a picture that will move.
        """
        self.moved = 0, 0
        self.tilt(moves=soon)
        self._make(targets, phases, soon)
        self.made[...] = phases
        # several patterns of a video are made `soon`, and others are not like them
        self.fits = soon or self.frames == 1

    def tilt(self, moves: bool) -> None:
        """Take the tilt of a still picture's light or of a moving one's, for the starts after this."""
        self.moves = moves
        for start in self.starts:
            start.tilt(moves)

    def _make(self, targets: Array, phases: Array, soon: bool) -> None:
        xp = self.backend.xp
        for c, (drive, start) in enumerate(zip(self.drives, self.starts, strict=True)):
            phase, *others = phases[c * self.frames : (c + 1) * self.frames]
            xp.multiply(targets[c, 0], 1 / self.backend.mean(targets[c, 0]), out=self.amplitude)
            xp.sqrt(self.amplitude, out=self.amplitude)
            alike: Sequence[Array] = ()
            network = self.initialiser
            if network is None or network.corrects:
                if start.doubled:
                    alike = others[: BOARDS - 1] if soon and network is None else ()
                    start.double_phase(self.amplitude, phase, alike, self.moved)
                else:
                    start.flat_phase(self.amplitude, phase)
            if network is not None:
                found = network.phase(self.backend.to_host(self.amplitude), self.backend.to_host(phase))
                phase[...] = xp.asarray(found)
            if drive.bounded:
                for one in (phase, *alike):
                    one[...] = drive.held(one)
            for n, other in enumerate(others[len(alike) :], 1 + len(alike)):
                self._part(n, drive, phase, other)

    def _part(self, n: int, drive: DriveRange, phase: Array, other: Array) -> None:
        """Fill the n-th pattern of a picture: the first one's phase and its own noise."""
        assert self.noise is not None
        moved = np.roll(self.noise, round(n * STRIDE * self.shape[0]) + n, 0)
        other[...] = phase
        other += self.backend.xp.asarray(moved)
        if drive.bounded:
            other[...] = drive.held(other)

    def warm(
        self,
        before: Array,
        motion: tuple[int, int],
        parts: Sequence[Part],
        targets: Array,
        phases: Array,
        room: Array,
        still: bool,
    ) -> None:
        """Fill `phases` with those of the frame before, moved as its content has moved.

        A pattern is a start, double phase, and what the descent has found since. Double phase stands on a chequerboard,
        which moves with the content. So what was found moves to the new frame's start, on the moved chequerboard. Where
        that start is dark its phase means nothing and changes from frame to frame, so there the pattern itself moves,
        and where the edges do not count it does so everywhere. Along the edges what was found stays in its place, as it
        compensates for the panel's end, and so does the chequerboard.

        Where the tilt of the light rises, the content of a pattern that moves as it is comes to a wrong place, as the
        tilt stays. So there what was found moves to the new start, also where the edges do not count.

        Patterns on different chequerboards do not go together. So parts that move by themselves follow only by an even
        number beside the whole, and begin anew otherwise.

        Parameters
        ----------
        before : float array [C N, H, W], rad
            Phases of the frame before.
        motion : (int, int), pixels
            Of the whole: down, right.
        parts : sequence of Part
            What moves otherwise, and what is new.
        targets : array [C, K, H, W]
            Of this frame: where content comes in, the start is cold.
        phases, room : float array [C N, H, W], rad
            The result, and room to work in.
        still : bool
            Whether this frame is the same picture as the one before.
        """
        if not any(motion) and not parts:
            phases[...] = before
            self.fits = self.fits and still
            return
        self.moved = self.moved[0] + motion[0], self.moved[1] + motion[1]
        self._make(targets, room, soon=True)
        self.made *= -1
        self.made += before  # what the descent has found since the start
        for n, (phase, fresh, found) in enumerate(zip(phases, room, self.made, strict=True)):
            drive, start = self.drives[n // self.frames], self.starts[n // self.frames]
            edges = start.light.edges
            adds = self.fits and not drive.bounded  # the sum may lie out of a bounded panel's range
            if parts and not adds:
                phase[...] = fresh
                continue
            shifted(before[n], motion, phase)
            start.retilt(motion, phase)
            down, right = start.light.rising
            rising = [(down, slice(None))] * bool(motion[0]) + [(slice(None), right)] * bool(motion[1])
            if adds:
                shifted(found, motion, self.on_fresh)
                self.on_fresh += fresh
                for part in [...] if parts or self.edges_count else rising:
                    self.backend.xp.copyto(phase[part], self.on_fresh[part], where=start.lit[part])
            elif not self.fits:
                for part in rising:
                    phase[part] = fresh[part]
            for one in parts:
                follow(phase, found, fresh, one, motion)
            near = all(2 * abs(step) <= edge for step, edge in zip(motion, edges, strict=True))
            for part in renewed(motion, edges, self.shape) if any(motion) else ():
                phase[part] = fresh[part]
                if adds and near:
                    phase[part] += found[part]
        self.made[...] = room
        self.fits = True
