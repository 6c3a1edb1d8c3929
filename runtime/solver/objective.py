"""The objective: light of a phase pattern through one or several light paths, against its targets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import Approximator
from runtime.solver.array_backend import Backend
from runtime.solver.in_place_path import Optics
from runtime.solver.penalty import FLOOR, PENALTIES, Irradiance
from runtime.solver.soft_levels import SoftLevels

Array = Any

# Share of the panel's band up to which irradiance is computed once a pixel. Up to a half that is exact; at 0.7, of
# 540 x 960 pixels and after 20 iterations, it gives 37.7 dB where the fine grid gives 37.8 for four times the work.
OPEN = 0.75
# Of the irradiance that the first pattern gives. Light that goes elsewhere leaves a descent more freedom, so without a
# limit it ends in the dark: 120 x 160 pixels keep 85 % after 100 iterations, 68 % after 300 and 28 % after 1000.
KEPT = 0.5


class Objective:
    """Loss over phase [C, H, W] for targets [C, K, H, W]: C colours with a pattern each, K planes a colour.

    A colour's planes share its pattern and its scale. With N patterns for a picture, phase is [C N, H, W], a
    colour's patterns after one another, and the loss is that of the mean of their irradiances. `look` comes before
    `gradient`, which uses up what it left.

    Parameters
    ----------
    stacks : list of list of LightPath
        Colours of planes.
    fine : bool
        Whether irradiance is computed on the light paths' fine grid; else once a pixel.
    penalty : str
        One of PENALTIES.
    weight : array [H, W] or None
        How much a pixel counts.
    approximator : Approximator or None
        D, which takes all colours of the first plane at once.
    backend : Backend
    frames : int
        N, the patterns for each colour of a picture.

    Attributes
    ----------
    rounding : SoftLevels or None
        What a panel of few levels makes of a phase.
    most_scale : list of float
        The limit of each colour's scale, on amplitude: see `keep_light`.
    """

    def __init__(
        self,
        stacks: Sequence[Sequence[LightPath]],
        fine: bool,
        penalty: str,
        weight: np.ndarray | None,
        approximator: Approximator | None,
        backend: Backend,
        frames: int = 1,
    ) -> None:
        xp, path = backend.xp, stacks[0][0]
        self.backend, self.stacks, self.frames = backend, stacks, frames
        self.approximator = approximator
        self.rounding: SoftLevels | None = None
        self.penalty = PENALTIES[penalty](xp)
        # On the panel's own grid light is taken at pixel centres: integrating it there took longer and gained nothing.
        filtered = any(p.irradiance_filter is not None for stack in stacks for p in stack)
        integrate = fine or filtered or approximator is not None
        # A pattern's fields are kept from `look` to `gradient`, so each has optics of its own.
        self.optics = [
            [Optics(p, p.grid.fine if fine else 1, integrate, backend) for p in stack]
            for stack in stacks
            for _ in range(frames)
        ]
        real = path.response.dtype
        self.shape = (len(stacks) * frames, *path.grid.shape)
        deep = (len(stacks), len(stacks[0]), *path.grid.shape)
        self.light = xp.zeros(deep, real)
        self.wanted = xp.zeros(deep, real)
        self.weight = None if weight is None else xp.asarray(weight, real)
        self.pixels = float(np.prod(deep)) if weight is None else float(np.sum(weight)) * deep[0] * deep[1]
        self.room = xp.zeros(self.shape[1:], real)
        self.strip = min(backend.strip_rows(path.grid.shape[1]), path.grid.shape[0])
        self.part = [xp.empty((self.strip, path.grid.shape[1]), real) for _ in range(backend.threads)]
        self.power = [float(np.mean(np.abs(stack[0].source) ** 2)) for stack in stacks]
        self.floor: list[float] = []
        self.looks = 0
        self.scale = [1.0] * len(stacks)
        self.most_scale = [math.inf] * len(stacks)
        self.least = [0.0] * len(stacks)  # irradiance of the brightest pixel
        self.brightest = [1.0] * len(stacks)  # that is asked for
        self.contrast = [1.0] * len(stacks)  # the same over the mean of all pixels
        self.asked, self.lit = ([1.0] * len(stacks) for _ in range(2))
        self.loss, self.squared_error, self.peak = math.inf, math.inf, 1.0

    def aim(self, targets: Array) -> None:
        """Change to other targets, irradiance [C, K, H, W] of any scale, none of them dark."""
        xp = self.backend.xp
        bare = isinstance(self.penalty, Irradiance)
        for c in range(len(self.stacks)):
            mean = float(targets[c].mean(dtype=np.float64))
            for k in range(self.wanted.shape[1]):
                wanted = self.wanted[c, k]
                wanted[...] = targets[c, k]
                wanted *= 1 / mean
                if self.approximator is None and not bare:
                    wanted += FLOOR
                    xp.sqrt(wanted, out=wanted)
            self.asked[c] = mean if self.weight is None else self._mean(targets[c])
            self.brightest[c] = float(targets[c].max())
            self.contrast[c] = self.brightest[c] / mean
        self._limit()
        self.floor = []
        top = float(self.wanted.max())
        self.peak = top if self.approximator is None and not bare else math.sqrt(top)

    def look(self, phase: Array) -> float:
        """The loss at a phase, mean over pixels; keeps what `gradient` needs."""
        if self.rounding is not None:
            self.rounding.round(phase)
            phase = self.rounding.phase
        for pattern, stack in enumerate(self.optics):
            c, again = divmod(pattern, self.frames)
            for k, optics in enumerate(stack):
                optics.forward(phase[pattern], self.room if again else self.light[c, k])
                if again:
                    self.light[c, k] += self.room
        if self.frames > 1:
            self.light *= 1 / self.frames
        first = not self.floor
        self.lit = [self._mean(light) for light in self.light]
        if first:
            self.mean_light = [float(self.light[c].mean()) for c in range(len(self.stacks))]
            self.floor = [FLOOR * mean for mean in self.mean_light]
        if self.approximator is not None:
            return self._look_through(self.approximator, first)
        loss = squares = 0.0
        for c in range(len(self.stacks)):
            planes = range(self.wanted.shape[1])
            sums = [self._measure(c, k) for k in planes]
            self.scale[c] = self.penalty.scale(tuple(map(sum, zip(*sums, strict=True))), self.most_scale[c])
            for k in planes:
                part = self._slope(c, k)
                loss, squares = loss + part[0], squares + part[1]
        self.loss, self.squared_error = loss / self.pixels, squares / self.pixels
        return self.loss

    def keep_light(self) -> None:
        """From now on, ask of the brightest pixel for at least a share `KEPT` of what it got at the last look.

        Or of the panel's own irradiance, where it got more; also for other pictures.
        """
        for c, given in enumerate(self.given):
            self.least[c] = KEPT * min(self.power[c], given * self.brightest[c])
        self._limit()

    def _limit(self) -> None:
        self.most_scale = [
            math.sqrt(contrast / least) if least else math.inf
            for contrast, least in zip(self.contrast, self.least, strict=True)
        ]

    def gradient(self, phase: Array, out: Array) -> None:
        """Gradient of the loss's sum over pixels over the patterns' phases of the last `look`, written to `out`."""
        if self.rounding is not None:
            phase = self.rounding.phase
        for pattern, stack in enumerate(self.optics):
            for k, optics in enumerate(stack):
                slope = self.light[pattern // self.frames, k]
                optics.adjoint(phase[pattern], slope, self.room if k else out[pattern])
                if k:
                    out[pattern] += self.room
        if self.frames > 1:
            out *= 1 / self.frames
        if self.rounding is not None:
            out *= self.rounding.slope

    def constrain(self, colour: int) -> None:
        """For Gerchberg-Saxton, in place of a slope: half of the factor that constrains each field."""
        for light in self.light[colour]:  # dLoss / dI = c^2 (1 - wanted / (c sqrt(I))), where it counts
            light *= -0.5 / self.scale[colour] ** 2
            light += 0.5

    @property
    def psnr_db(self) -> float:
        """Amplitude PSNR of the last look, on the solver's own grid."""
        return 20 * math.log10(self.peak / max(math.sqrt(self.squared_error), 1e-15))

    @property
    def given(self) -> tuple[float, ...]:
        """Irradiance that a target of 1 gets at the phase of the last look, for each colour: the ratio of their means.

        Light that does not follow the target counts, too: the eye sees it.
        """
        return tuple(lit / asked for lit, asked in zip(self.lit, self.asked, strict=True))

    def curvature(self, pattern: int) -> float:
        """The loss's approximate second derivative over a pixel's phase, for a path that loses no light."""
        colour = pattern // self.frames
        share = self.power[colour] / self.frames
        if self.approximator is not None:
            return share / self.mean_light[colour]
        rms = math.sqrt(self.squared_error)
        bend = self.penalty.curvature(self.scale[colour], self.mean_light[colour], rms)
        return bend * share * len(self.stacks[colour])

    def _mean(self, values: Array) -> float:
        """Mean of [K, H, W] where it counts."""
        if self.weight is None:
            return float(values.mean())
        return float((values * self.weight).sum()) / (float(self.weight.sum()) * len(values))

    def _measure(self, c: int, k: int) -> tuple[float, ...]:
        light, wanted, weight, floor = self.light[c, k], self.wanted[c, k], self.weight, self.floor[c]

        def work(worker: int, rows: slice) -> tuple[float, ...]:
            some = None if weight is None else weight[rows]
            return self.penalty.measure(light[rows], wanted[rows], some, floor)

        return self.backend.over_rows(len(light), self.strip, work)

    def _slope(self, c: int, k: int) -> tuple[float, ...]:
        light, wanted, weight, scale = self.light[c, k], self.wanted[c, k], self.weight, self.scale[c]

        def work(worker: int, rows: slice) -> tuple[float, ...]:
            some = None if weight is None else weight[rows]
            error = self.part[worker][: rows.stop - rows.start]
            return self.penalty.slope(light[rows], wanted[rows], some, scale, error)

        return self.backend.over_rows(len(light), self.strip, work)

    def _look_through(self, d: Approximator, first: bool) -> float:
        """The loss of the light after D, mean over pixels."""
        xp = self.backend.xp
        for c in range(len(self.stacks)):
            light, wanted = self.light[c, 0], self.wanted[c, 0]
            xp.multiply(light, 1 / self.mean_light[c], out=light)
            d.irradiance[c] = self.backend.to_host(light)
            self.scale[c] = min(
                _root_scale(light, wanted), self.most_scale[c] * math.sqrt(self.mean_light[c])
            )
        self.looks = 1 if first else self.looks + 1
        if self.looks & (self.looks - 1) == 0:
            # D's scale over the light's changes ever more slowly: it is measured at looks 1, 2, 4, 8 ... only.
            d.correct()
            self.through = [
                _root_scale(xp.asarray(d.corrected[c]), self.wanted[c, 0]) / self.scale[c]
                for c in range(len(self.stacks))
            ]
        units = [max(self.scale[c] * self.through[c], 1e-15) ** 2 for c in range(len(self.stacks))]
        for c, unit in enumerate(units):
            np.multiply(self.backend.to_host(self.wanted[c, 0]), 1 / unit, out=d.target[c])
        loss = d.look()
        for c in range(len(self.stacks)):
            self.light[c, 0] = xp.asarray(d.slope[c])
            self.light[c, 0] *= 1 / self.mean_light[c]
        self.loss = self.squared_error = loss / self.pixels * float(np.mean(units))
        return self.loss


def needs_fine_grid(stacks: Sequence[Sequence[LightPath]]) -> bool:
    """Whether irradiance once a pixel is too coarse for any of these paths: see `OPEN`."""
    return any(path.grid.band_share > OPEN for stack in stacks for path in stack)


def _root_scale(light: Array, target: Array) -> float:
    """c for which c sqrt(light) is nearest to sqrt(target)."""
    root, wanted = np.sqrt(np.maximum(light, 0)), np.sqrt(target)
    return float((root * wanted).sum() / max(float((root * root).sum()), 1e-30))
