"""Methods of phase retrieval by name: how the next phase comes from the one whose light was just computed.

Memoryless BFGS, Adam and Gerchberg-Saxton. A method has `begin()`, called for each picture, and
`step(phase, out)`, which writes the phase that follows [C, H, W] to `out`. All are in place. What they have in
common (the start, the best pattern met, the deadline) is in `runtime.solver.solver`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

from runtime.solver.array_backend import Array, Number
from runtime.solver.drive_range import DriveRange
from runtime.solver.objective import Objective

LONGEST = 0.5  # step of a pixel, rad, where its range has ends


class Method(Protocol):
    """A way to improve a pattern."""

    def begin(self) -> None:
        """Forget the picture before."""

    def step(self, phase: Array, out: Array) -> None:
        """The next phase, after `Objective.look(phase)`."""


class MemorylessBfgs:
    """Memoryless BFGS (L-BFGS with one pair), one gradient a step and no line search.

    Where phases a turn apart do not act the same (crosstalk mixes them; a drive of less than a turn lacks some),
    steps are projected onto the panel's range, and pixels that are pushed out of it stay out of the curvature.

    References
    ----------
    Shanno 1978; Bertsekas 1982.
    """

    def __init__(self, objective: Objective, drives: Sequence[DriveRange]) -> None:
        xp = objective.backend.xp
        self.objective, self.drives, self.backend = objective, drives, objective.backend
        real = objective.light.dtype
        self.gradient, self.before, self.move = (xp.zeros(objective.shape, real) for _ in range(3))
        self.bounded = any(drive.bounded for drive in drives)
        self.products = xp.zeros(3)
        self._multiply = self.backend.recorded(self._multiply_now)
        self.begin()

    def begin(self) -> None:
        """Start from steepest descent."""
        self.first = True
        # Scalar products of the gradient before with itself and with the move, where they follow from the last step's.
        self.known: tuple[float, float] | None = None

    def step(self, phase: Array, out: Array) -> None:
        """One step: the move is a sum of this gradient, the one before and the move before."""
        self.gradient, self.before = self.before, self.gradient
        self.objective.gradient(phase, self.gradient)
        if self.bounded:
            self._hold(phase)
        a, b, c = self._coefficients()
        for colour in range(len(phase)):
            self._move(colour, a[colour], b, c, phase[colour], out[colour])
        self.first = False

    def _coefficients(self) -> tuple[list[float], float, float]:
        """Factors of the gradient (a colour each), of the one before and of the move before."""
        steepest = [-1 / self.objective.curvature(c) for c in range(len(self.gradient))]
        known, self.known = self.known, None
        if self.first:
            return steepest, 0.0, 0.0
        gradient, before, move = self.gradient, self.before, self.move
        gg, go, sg = self._dots(gradient, gradient, gradient, before, move, gradient)
        oo, so = known or self._dots(before, before, move, before)
        sy, yy, yg = sg - so, gg - 2 * go + oo, gg - go
        if not sy > 1e-12 * yy > 0:  # without curvature, or where rounding is all that is left of the change
            return steepest, 0.0, 0.0
        gamma, along = sy / yy, sg / sy
        beta = gamma * (yg - along * yy) / sy
        a, b, c = gamma * (along - 1), -gamma * along, beta - along
        if not self.bounded:  # the next move is this sum, and this gradient will be the one before
            self.known = gg, a * gg + b * go + c * sg
        return [a] * len(steepest), b, c

    def _dots(self, *arrays: Array) -> list[float]:
        """Scalar products of arrays [C, H, W], each with the one after it in pairs."""
        self._multiply(*arrays)
        return list(self.backend.to_host(self.products)[: len(arrays) // 2].tolist())

    def _multiply_now(self, *arrays: Array) -> None:
        pairs, dot, sums = list(zip(arrays[::2], arrays[1::2], strict=True)), self.backend.dot, []
        for colour in range(len(self.gradient)):

            def work(worker: int, rows: slice, colour: int = colour) -> tuple[Number, ...]:
                return tuple(dot(u[colour, rows], v[colour, rows]) for u, v in pairs)

            sums.append(self.backend.over_rows(self.gradient.shape[1], self.objective.strip, work))
        for n, each in enumerate(zip(*sums, strict=True)):
            self.products[n] = sum(each)

    def _move(self, colour: int, a: float, b: float, c: float, phase: Array, out: Array) -> None:
        xp, drive = self.backend.xp, self.drives[colour]
        gradient, before, move = self.gradient[colour], self.before[colour], self.move[colour]

        def work(worker: int, rows: slice) -> None:
            part, s = self.objective.part[worker][: rows.stop - rows.start], move[rows]
            s *= c
            for factor, of in ((a, gradient), (b, before)):
                if factor:
                    xp.multiply(of[rows], factor, out=part)
                    s += part
            if self.bounded:
                xp.clip(s, -LONGEST, LONGEST, out=s)
            xp.add(phase[rows], s, out=out[rows])

        self.backend.over_rows(len(phase), self.objective.strip, work)
        if self.bounded:
            xp.clip(out, drive.low, drive.high, out=out)
            xp.subtract(out, phase, out=move)

    def _hold(self, phase: Array) -> None:
        """Set the step of pixels that are pushed out of the panel's range to zero."""
        for colour, drive in enumerate(self.drives):
            free = ~drive.pushed_out(phase[colour], self.gradient[colour])
            self.gradient[colour] *= free
            if not self.first:
                self.before[colour] *= free
                self.move[colour] *= free


class Adam:
    """Gradient descent with Adam.

    Parameters
    ----------
    objective : Objective
    drives : list of DriveRange
        Of the colours.
    rate : float, rad
        By default the one that the field publishes.
    betas : (float, float)

    References
    ----------
    Kingma and Ba 2015.
    """

    def __init__(
        self,
        objective: Objective,
        drives: Sequence[DriveRange],
        rate: float = 8e-3,
        betas: tuple[float, float] = (0.9, 0.999),
    ) -> None:
        xp = objective.backend.xp
        self.objective, self.backend = objective, objective.backend
        self.rate, self.betas = rate, betas
        real = objective.light.dtype
        self.gradient, self.mean, self.square = (xp.zeros(objective.shape, real) for _ in range(3))
        self.steps = 0

    def begin(self) -> None:
        """Forget the moments."""
        self.mean[...] = 0
        self.square[...] = 0
        self.steps = 0

    def step(self, phase: Array, out: Array) -> None:
        """One step of at most about the rate."""
        xp, (first, second) = self.backend.xp, self.betas
        self.objective.gradient(phase, self.gradient)
        self.steps += 1
        root = math.sqrt(1 - second**self.steps)
        rate = -self.rate * root / (1 - first**self.steps)
        for g, m, v, old, new in zip(self.gradient, self.mean, self.square, phase, out, strict=True):

            def work(
                worker: int,
                rows: slice,
                g: Array = g,
                m: Array = m,
                v: Array = v,
                old: Array = old,
                new: Array = new,
            ) -> None:
                part = self.objective.part[worker][: rows.stop - rows.start]
                m[rows] *= first
                xp.multiply(g[rows], 1 - first, out=part)
                m[rows] += part
                xp.multiply(g[rows], g[rows], out=part)
                part *= 1 - second
                v[rows] *= second
                v[rows] += part
                xp.sqrt(v[rows], out=part)
                part += 1e-8 * root
                xp.divide(m[rows], part, out=part)
                part *= rate
                xp.add(old[rows], part, out=new[rows])

            self.backend.over_rows(len(g), self.objective.strip, work)


class GerchbergSaxton:
    """Gerchberg-Saxton: the target's amplitude with the image's phase, back to the panel, where the phase is kept.

    Where pixels do not count, the image stays as it is. With several modes and planes, their fields at the panel
    are added.

    References
    ----------
    Gerchberg and Saxton 1972.
    """

    def __init__(self, objective: Objective, drives: Sequence[DriveRange]) -> None:
        xp = objective.backend.xp
        self.objective, self.backend = objective, objective.backend
        pair = objective.stacks[0][0].source.dtype
        self.wave, self.other = (xp.zeros(objective.shape[1:], pair) for _ in range(2))

    def begin(self) -> None:
        """This method keeps nothing between steps."""

    def step(self, phase: Array, out: Array) -> None:
        """The phase at the panel of the constrained image."""
        xp = self.backend.xp
        for c, stack in enumerate(self.objective.optics):
            self.objective.constrain(c)
            for k, optics in enumerate(stack):
                optics.adjoint_wave(self.objective.light[c, k], self.other if k else self.wave)
                if k:
                    self.wave += self.other
            source = optics.panel.source
            if source is not None:
                self.wave *= source.conj()
            wave, new = self.wave, out[c]

            def work(worker: int, rows: slice, wave: Array = wave, new: Array = new) -> None:
                xp.arctan2(wave[rows].imag, wave[rows].real, out=new[rows])

            self.backend.over_rows(len(wave), self.objective.strip, work)


METHODS: dict[str, Any] = {
    "bfgs": MemorylessBfgs,
    "adam": Adam,
    "gerchberg_saxton": GerchbergSaxton,
    "double_phase": None,  # the start alone
}
DESCENTS = ("bfgs", "adam")  # go down the objective's gradient, so they take several patterns and few levels
OLDER_NAMES = {"default": "bfgs"}  # still accepted
