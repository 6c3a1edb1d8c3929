"""The objective: light of a phase pattern through one or several light paths, against its targets."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import Approximator
from runtime.solver.array_backend import Array, Backend, Number
from runtime.solver.in_place_path import Optics
from runtime.solver.penalty import FLOOR, PENALTIES, Irradiance
from runtime.solver.soft_levels import SoftLevels

# What a look measures of a colour: the mean light where it counts, the mean light of the first look, the scale c on
# amplitude, and sums of the loss and of the squared error of amplitude.
MEASURED = ("lit", "mean", "scale", "loss", "squares")
LIT, MEAN, SCALE, LOSS, SQUARES = range(len(MEASURED))

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
    most_scale : float array [C]
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
        self.penalty = PENALTIES[penalty](backend)
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
        self.counted = 0.0 if weight is None else float(np.sum(weight))
        self.pixels = float(np.prod(deep)) if weight is None else float(np.sum(weight)) * deep[0] * deep[1]
        self.room = xp.zeros(self.shape[1:], real)
        self.strip = min(backend.strip_rows(path.grid.shape[1]), path.grid.shape[0])
        self.part = [xp.empty((self.strip, path.grid.shape[1]), real) for _ in range(backend.threads)]
        self.power = [float(np.mean(np.abs(stack[0].source) ** 2)) for stack in stacks]
        colours = len(stacks)
        self.looks = 0
        self.least = [0.0] * colours  # irradiance of the brightest pixel
        self.brightest = [1.0] * colours  # that is asked for
        self.contrast = [1.0] * colours  # the same over the mean of all pixels
        self.asked = [1.0] * colours
        self.peak = 1.0
        # A colour's numbers are where its light is, and the host asks for all at once.
        self.floor, self.most_scale = xp.zeros(colours, real), xp.full(colours, math.inf, real)
        self.measured = xp.zeros((colours, len(MEASURED)), np.float64)
        self.found = np.ones((colours, len(MEASURED)))
        self.fresh = True
        self._measure = backend.recorded(self._measure_now)
        self._go_back = backend.recorded(self._go_back_now)

    def aim(self, targets: Array) -> None:
        """Change to other targets, irradiance [C, K, H, W] of any scale, none of them dark."""
        xp, backend = self.backend.xp, self.backend
        bare = isinstance(self.penalty, Irradiance) or self.approximator is not None
        weighted = self.weight is not None
        sums = [n for t in targets for n in (backend.mean(t), t.max(), self._mean(t) if weighted else 0.0)]
        numbers = np.reshape(backend.floats(*sums), (-1, 3))
        tops = []
        for c, (mean, brightest, counted) in enumerate(numbers.tolist()):
            self.asked[c] = counted if weighted else mean
            self.brightest[c], self.contrast[c] = brightest, brightest / mean
            for wanted, target in zip(self.wanted[c], targets[c], strict=True):
                xp.multiply(target, 1 / mean, out=wanted)
                if not bare:
                    wanted += FLOOR
                    xp.sqrt(wanted, out=wanted)
            tops.append(brightest / mean + (0.0 if bare else FLOOR))
        self._limit()
        self.peak, self.fresh = math.sqrt(max(tops)), True

    def look(self, phase: Array) -> float:
        """The loss at a phase, mean over pixels; keeps what `gradient` needs."""
        if self.rounding is not None:
            self.rounding.round(phase)
            phase = self.rounding.phase
        first, self.fresh = self.fresh, False
        if self.approximator is not None:
            self._shine(phase, first)
            self.found = self.backend.to_host(self.measured)
            return self._look_through(self.approximator, first)
        self._measure(phase, first)
        self.found = self.backend.to_host(self.measured)
        return self.loss

    def _shine(self, phase: Array, first: bool) -> None:
        """Fill `light`, and measure its mean."""
        for pattern, stack in enumerate(self.optics):
            c, again = divmod(pattern, self.frames)
            for k, optics in enumerate(stack):
                optics.forward(phase[pattern], self.room if again else self.light[c, k])
                if again:
                    self.light[c, k] += self.room
        if self.frames > 1:
            self.light *= 1 / self.frames
        for c, light in enumerate(self.light):
            self.measured[c, LIT] = mean = self._mean(light)
            if first:
                if self.weight is not None:  # of all pixels, also those that do not count
                    mean = self.backend.total(light) / light.size
                self.measured[c, MEAN] = mean
                self.floor[c] = FLOOR * mean

    def _measure_now(self, phase: Array, first: bool) -> None:
        """Fill `measured` for a phase, and make `light` the slope of the loss over it."""
        self._shine(phase, first)
        for c in range(len(self.stacks)):
            planes = range(self.wanted.shape[1])
            sums = [self._compare(c, k) for k in planes]
            scale = self.penalty.scale(tuple(map(sum, zip(*sums, strict=True))), self.most_scale[c])
            parts = [self._slope(c, k, scale) for k in planes]
            self.measured[c, SCALE] = scale
            for place, part in zip((LOSS, SQUARES), zip(*parts, strict=True), strict=True):
                self.measured[c, place] = sum(part)

    def keep_light(self) -> None:
        """From now on, ask of the brightest pixel for at least a share `KEPT` of what it got at the last look.

        Or of the panel's own irradiance, where it got more; also for other pictures.
        """
        for c, given in enumerate(self.given):
            self.least[c] = KEPT * min(self.power[c], given * self.brightest[c])
        self._limit()

    def _limit(self) -> None:
        most = [
            math.sqrt(contrast / least) if least else math.inf
            for contrast, least in zip(self.contrast, self.least, strict=True)
        ]
        self.most_scale[...] = self.backend.xp.asarray(most, self.most_scale.dtype)

    def gradient(self, phase: Array, out: Array) -> None:
        """Gradient of the loss's sum over pixels over the patterns' phases of the last `look`, written to `out`."""
        if self.rounding is not None:
            phase = self.rounding.phase
        self._go_back(phase, out)
        if self.rounding is not None:
            out *= self.rounding.slope

    def _go_back_now(self, phase: Array, out: Array) -> None:
        for pattern, stack in enumerate(self.optics):
            for k, optics in enumerate(stack):
                slope = self.light[pattern // self.frames, k]
                optics.adjoint(phase[pattern], slope, self.room if k else out[pattern])
                if k:
                    out[pattern] += self.room
        if self.frames > 1:
            out *= 1 / self.frames

    def constrain(self, colour: int) -> None:
        """For Gerchberg-Saxton, in place of a slope: half of the factor that constrains each field."""
        for light in self.light[colour]:  # dLoss / dI = c^2 (1 - wanted / (c sqrt(I))), where it counts
            light *= -0.5 / self.scale(colour) ** 2
            light += 0.5

    def scale(self, colour: int) -> float:
        """c of a colour, at the last look."""
        return float(self.found[colour, SCALE])

    @property
    def loss(self) -> float:
        """Mean over pixels, at the last look."""
        return float(self.found[:, LOSS].sum()) / self.pixels

    @property
    def squared_error(self) -> float:
        """Of amplitude, mean over pixels, at the last look."""
        return float(self.found[:, SQUARES].sum()) / self.pixels

    @property
    def psnr_db(self) -> float:
        """Amplitude PSNR of the last look, on the solver's own grid."""
        return 20 * math.log10(self.peak / max(math.sqrt(self.squared_error), 1e-15))

    @property
    def given(self) -> tuple[float, ...]:
        """Irradiance that a target of 1 gets at the phase of the last look, for each colour: the ratio of their means.

        Light that does not follow the target counts, too: the eye sees it.
        """
        return tuple(lit / asked for lit, asked in zip(self.found[:, LIT].tolist(), self.asked, strict=True))

    def curvature(self, pattern: int) -> float:
        """The loss's approximate second derivative over a pixel's phase, for a path that loses no light."""
        colour = pattern // self.frames
        share, mean_light = self.power[colour] / self.frames, float(self.found[colour, MEAN])
        if self.approximator is not None:
            return share / mean_light
        rms = math.sqrt(self.squared_error)
        bend = self.penalty.curvature(self.scale(colour), mean_light, rms)
        return bend * share * len(self.stacks[colour])

    def _mean(self, values: Array) -> Number:
        """Mean of [K, H, W] where it counts."""
        if self.weight is None:
            return self.backend.total(values) / values.size
        return self.backend.total(values * self.weight) / (self.counted * len(values))

    def _compare(self, c: int, k: int) -> tuple[Number, ...]:
        light, wanted, weight, floor = self.light[c, k], self.wanted[c, k], self.weight, self.floor[c]

        def work(worker: int, rows: slice) -> tuple[Number, ...]:
            some = None if weight is None else weight[rows]
            return self.penalty.measure(light[rows], wanted[rows], some, floor)

        return self.backend.over_rows(len(light), self.strip, work)

    def _slope(self, c: int, k: int, scale: Number) -> tuple[Number, ...]:
        light, wanted, weight = self.light[c, k], self.wanted[c, k], self.weight

        def work(worker: int, rows: slice) -> tuple[Number, ...]:
            some = None if weight is None else weight[rows]
            error = self.part[worker][: rows.stop - rows.start]
            return self.penalty.slope(light[rows], wanted[rows], some, scale, error)

        return self.backend.over_rows(len(light), self.strip, work)

    def _look_through(self, d: Approximator, first: bool) -> float:
        """The loss of the light after D, mean over pixels."""
        xp, means = self.backend.xp, self.found[:, MEAN].tolist()
        most, scales = self.backend.to_host(self.most_scale).tolist(), []
        for c, mean in enumerate(means):
            light, wanted = self.light[c, 0], self.wanted[c, 0]
            xp.multiply(light, 1 / mean, out=light)
            d.irradiance[c] = self.backend.to_host(light)
            scales.append(min(_root_scale(light, wanted), most[c] * math.sqrt(mean)))
        self.looks = 1 if first else self.looks + 1
        if self.looks & (self.looks - 1) == 0:
            # D's scale over the light's changes ever more slowly: it is measured at looks 1, 2, 4, 8 ... only.
            d.correct()
            self.through = [
                _root_scale(xp.asarray(d.corrected[c]), self.wanted[c, 0]) / scale
                for c, scale in enumerate(scales)
            ]
        units = [max(s * t, 1e-15) ** 2 for s, t in zip(scales, self.through, strict=True)]
        for c, unit in enumerate(units):
            np.multiply(self.backend.to_host(self.wanted[c, 0]), 1 / unit, out=d.target[c])
        loss = d.look()
        for c, mean in enumerate(means):
            self.light[c, 0] = xp.asarray(d.slope[c])
            self.light[c, 0] *= 1 / mean
        self.found[:, SCALE] = scales
        self.found[:, LOSS] = self.found[:, SQUARES] = loss * float(np.mean(units)) / len(units)
        return self.loss


def needs_fine_grid(stacks: Sequence[Sequence[LightPath]]) -> bool:
    """Whether irradiance once a pixel is too coarse for any of these paths: see `OPEN`."""
    return any(path.grid.band_share > OPEN for stack in stacks for path in stack)


def _root_scale(light: Array, target: Array) -> float:
    """c for which c sqrt(light) is nearest to sqrt(target)."""
    root, wanted = np.sqrt(np.maximum(light, 0)), np.sqrt(target)
    return float((root * wanted).sum() / max(float((root * root).sum()), 1e-30))
