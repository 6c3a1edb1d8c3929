"""Displacement and blur of each capture's picture, measured from the capture itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor

from trainer.kept_results import kept_by_device
from trainer.prediction.stages import Sensor

STEPS = 6  # of Gauss-Newton, from where a displacement is off by a part of a speckle at most
MOST = 1.0  # panel pixels that one step may move
ARRIVED = 0.01  # panel pixels: the next step would be the square of this
# Displacements along rows and columns at which pictures are correlated to find such a place, panel pixels.
TRIED_SHIFTS = np.linspace(-8, 8, 65)
BLIND = 0.8  # share of the highest correlation from which Gauss-Newton finds there by itself
NEARER = 0.05  # of the correlation that the farthest place loses: gratings repeat, and of two alike the nearer is meant
# Widths of blurs, as shares of the usual one: the widest at first, and in the end, where the widest fits best.
WIDEST_BLUR, LIMIT = 2.4, 9.6
NEARLY_WIDEST = 0.95
TRIED_BLURS = 6, 2.1  # how many between two widths: a few, and so many more a usual width
# Where the captures' motions leave less than this share of a change, it is one of theirs, and what is left is rounding,
# with which fits would walk far.
MOTION_ALONE = 0.02
DEAD = 1e-3  # sensitivity of a pixel below which it shows no change
BLUR_STEP = 0.05  # for derivatives, share of the usual width
RESPONSE = -0.1, 1.5, 2049  # shares of full scale between which a response is turned back, and how many
FLAT = 0.05  # least slope that a response is turned back with
BETWEEN = np.linspace(0, 1, 161)  # two widths: where the best one is looked for


@dataclass(frozen=True)
class Motion:
    """How each capture's picture is moved, in numbers of its own.

    Attributes
    ----------
    shift : Tensor [B, 2] or None
        Displacement along rows and columns, panel pixels.
    blur : Tensor [B] or None
        Width of the blur, share of the usual one.
    """

    shift: Tensor | None
    blur: Tensor | None

    def filter(self, sensor: Sensor) -> Tensor:
        """Transfer functions [B, n, m] of the motions of a sensor that `moves` in these ways."""
        parts = []
        if self.shift is not None:
            parts.append(_ramp(sensor, self.shift))
        if self.blur is not None and sensor.capture_blur is not None:
            parts.append(torch.stack([sensor.capture_blur(b**2) for b in self.blur]))
        return reduce(torch.mul, parts)

    def light_of(self, sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor]) -> Tensor:
        """Light on the camera's pixels [B, h, w] of a spectrum before its motion."""
        return read(spectrum * self.filter(sensor))


def measured_motion(
    sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor], measured: tuple[Tensor, Tensor]
) -> Motion:
    """The motion of each capture as the captures themselves show it, of a sensor that `moves`.

    Parameters
    ----------
    spectrum : complex Tensor [B, n, m]
        Of the pictures over the frequencies (iy, ix), before their motion.
    read : callable
        Gives the light on the camera's pixels, [B, h, w], of such a spectrum.
    measured : (Tensor, Tensor)
        Signal and weight, [B, h, w].
    """
    with torch.no_grad():
        spectrum, shift, blur = spectrum.detach(), None, None
        signal = straight_signal(sensor, *measured)
        if sensor.free_capture_shift:
            shift = _far_shift(sensor, spectrum, read, *signal)
            for _ in range(STEPS):
                step = _step(sensor, spectrum * _ramp(sensor, shift), read, *signal)
                shift = shift + step
                if float(step.abs().max()) < ARRIVED:
                    break
            spectrum = spectrum * _ramp(sensor, shift)
        if sensor.capture_blur is not None:
            blur = _blur(sensor, sensor.capture_blur, spectrum, read, *signal)
    return Motion(shift, blur)


@dataclass(frozen=True)
class MotionNearby:
    """Light under models a small step from one whose captures' motions are known, for derivatives.

    To measure each motion anew is most of the work. To first order it takes up that part of the light's change that
    looks like more motion: the change is projected (variable projection).

    Attributes
    ----------
    sensor : Sensor
        Of the model whose motions these are.
    filter : Tensor [B, n, m]
        Transfer functions of its motions.
    measured : (Tensor, Tensor)
        Signal and weight, [B, h, w].
    beyond : Tensor [B, h, w]
        What that model's light has more than the captures show, on the sensor: the motions make it smallest.
    counts : Tensor [B, 1, 1]
        Counts for a unit of light on the sensor.
    slopes : Tensor [B, k, h w]
        How the light changes with each number of the motion.
    weighted : Tensor [B, k + 1, h w]
        How `beyond` changes with these and with brightness, weighted as where motions are measured.
    inverse : Tensor [B, k + 1, k + 1]
        Of their products.

    References
    ----------
    Kaufman 1975: the derivative of a variable projection without the projection's own.
    """

    sensor: Sensor
    filter: Tensor
    measured: tuple[Tensor, Tensor]
    beyond: Tensor
    counts: Tensor
    slopes: Tensor
    weighted: Tensor
    inverse: Tensor

    def suits(self, sensor: Sensor) -> bool:
        """Whether a sensor has the same motions: to first order, one of another shape would look like more of it."""
        if sensor.free_capture_shift != self.sensor.free_capture_shift:
            return False
        if sensor.capture_blur is self.sensor.capture_blur:
            return True
        blur, own = sensor.usual_blur, self.sensor.usual_blur
        return blur is not None and own is not None and torch.equal(blur, own)

    def light_of(self, sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor]) -> Tensor:
        """Light on the camera's pixels [B, h, w] of a spectrum before its motion."""
        light = read(spectrum * self.filter)
        signal, _ = straight_signal(sensor, *self.measured)
        change = _on_sensor(sensor, light) - signal / self.counts - self.beyond
        taken_up = self.inverse @ (self.weighted @ change.flatten(1)[:, :, None]).double()
        followed = (taken_up[:, :-1].to(light.dtype).mT @ self.slopes).reshape(light.shape)
        left = torch.linalg.vector_norm(change - _on_sensor(sensor, followed))
        if left < MOTION_ALONE * torch.linalg.vector_norm(change):
            followed = change if sensor.gain is None else change / sensor.gain.clamp(min=DEAD)
        return light - followed


def motion_nearby(
    sensor: Sensor,
    spectrum: Tensor,
    read: Callable[[Tensor], Tensor],
    measured: tuple[Tensor, Tensor],
    motion: Motion,
) -> MotionNearby:
    """What derivatives need of a model's motions; the parameters are those of `measured_motion`, and what it gave."""
    moving = motion.filter(sensor)
    moved, slopes = spectrum * moving, []
    light = read(moved)
    if motion.shift is not None:
        slopes += [read(moved * (2j * math.pi * f)) for f in (sensor.iy, sensor.ix)]
    if motion.blur is not None:
        more = replace(motion, blur=motion.blur + BLUR_STEP)
        free = (motion.blur > BLUR_STEP).to(light.dtype)  # none has less blur than none
        slopes.append((read(spectrum * more.filter(sensor)) - light) / BLUR_STEP * free[:, None, None])
    signal, weight = straight_signal(sensor, *measured)
    on_sensor = _on_sensor(sensor, light)
    stacked = torch.stack([*(_on_sensor(sensor, one) for one in slopes), on_sensor], 1).flatten(2)
    weighted = stacked * weight.flatten(1)[:, None]
    products = (weighted @ stacked.mT).double()
    power = products[:, -1, -1, None, None].clamp(min=1e-30)
    counts = _sum(weight * signal * on_sensor)[:, None, None] / power
    counts = torch.where(counts > 0, counts, 1.0).to(light.dtype)
    return MotionNearby(
        sensor,
        moving,
        measured,
        on_sensor - signal / counts,
        counts,
        torch.stack(slopes, 1).flatten(2),
        weighted,
        torch.linalg.pinv(products, rtol=1e-12, hermitian=True),
    )


def _blur(
    sensor: Sensor,
    blur: Callable[[Tensor], Tensor],
    spectrum: Tensor,
    read: Callable[[Tensor], Tensor],
    signal: Tensor,
    weight: Tensor,
) -> Tensor:
    """Width of each capture's blur [B], share of the usual one."""
    least, widest = 0.0, WIDEST_BLUR
    best = torch.zeros(len(signal), dtype=torch.float64)
    highest = torch.full_like(best, -1.0)
    while True:
        amounts, interpolation = _blurs_tried(least, widest)
        sums = []
        for amount in amounts:
            tried = blur(torch.tensor(amount, dtype=sensor.iy.dtype))
            picture = _on_sensor(sensor, read(spectrum * tried))
            weighted = weight * picture
            sums.append(torch.stack([_sum(weighted * signal), _sum(weighted * picture)]))
        place, score = _best_between(torch.stack(sums, -1), interpolation)
        best = torch.where(score > highest, least + place * (widest - least), best)
        highest = torch.maximum(score, highest)
        if widest >= LIMIT or bool((best < NEARLY_WIDEST * widest).all()):
            return best.to(sensor.iy.dtype)
        least, widest = widest, 2 * widest


@kept_by_device(3)
def _blurs_tried(least: float, widest: float) -> tuple[tuple[float, ...], Tensor]:
    """Squares of the widths that are tried, and the matrix that interpolates from these to BETWEEN, float64.

    What a picture's products with others are is smooth in the square of its blur's width, so a few Chebyshev points
    tell all between two widths.
    """
    tried = round(TRIED_BLURS[0] + TRIED_BLURS[1] * (widest - least))
    nodes = chebyshev.chebpts1(tried)
    there = chebyshev.chebvander(nodes, tried - 1)
    begin, reach = least**2, widest**2 - least**2
    squares = (least + BETWEEN * (widest - least)) ** 2
    between = chebyshev.chebvander(2 * (squares - begin) / reach - 1, tried - 1)
    return tuple(begin + 0.5 * (1 + nodes) * reach), torch.as_tensor(np.linalg.solve(there.T, between.T).T)


def _best_between(sums: Tensor, interpolation: Tensor) -> tuple[Tensor, Tensor]:
    """Where between two widths blurred pictures fit best, [B], 0 to 1, and by how much they then fit better, [B].

    Parameters
    ----------
    sums : Tensor [2, B, K], float64
        Products of the blurred pictures with the measured ones, and with themselves.
    interpolation : Tensor [N, K]
        From the blurs tried to BETWEEN.
    """
    product, power = sums @ interpolation.T
    power = torch.maximum(power, 0.5 * sums[1].amin(1, keepdim=True)).clamp(min=1e-30)
    score = product.clamp(min=0) ** 2 / power  # with the best brightness, the misfit falls by this
    best = score.argmax(1).clamp(1, len(BETWEEN) - 2)
    before, here, after = (score.gather(1, best[:, None] + k)[:, 0] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    part = torch.where(bend < 0, 0.5 * (before - after) / torch.where(bend < 0, bend, -1.0), 0.0)
    part = torch.where(bend < 0, part, torch.sign(after - before))
    return (best + part.clamp(-1, 1)) * BETWEEN[1], score.amax(1)


def straight_signal(sensor: Sensor, observed: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Counts and weight as of a camera that adds nothing and responds in proportion to light, [B, h, w]."""
    if sensor.response is not None:
        shares = torch.linspace(*RESPONSE, dtype=observed.dtype)
        curve = (sensor.responded(shares * sensor.full_scale) / sensor.full_scale).cummax(0).values
        seen = (observed / sensor.full_scale).contiguous()
        k = torch.searchsorted(curve, seen).clamp(1, len(curve) - 1)
        step = shares[1] - shares[0]
        slope = ((curve[k] - curve[k - 1]) / step).clamp(min=FLAT)
        observed = (shares[k - 1] + (seen - curve[k - 1]) / slope) * sensor.full_scale
        weight = weight * slope**2
    return (observed if (added := sensor.added) is None else observed - added), weight


def _sum(pictures: Tensor) -> Tensor:
    return pictures.sum((-2, -1), dtype=torch.float64)


def _on_sensor(sensor: Sensor, light: Tensor) -> Tensor:
    return light if sensor.gain is None else light * sensor.gain


def _ramp(sensor: Sensor, shift: Tensor) -> Tensor:
    """Transfer functions of displacements [B, 2], panel pixels: light of a place that much farther on."""
    return _phasors(sensor.iy * shift[..., :1, None] + sensor.ix * shift[..., 1:, None])


def _phasors(cycles: Tensor) -> Tensor:
    angle = 2 * math.pi * cycles
    return torch.polar(torch.ones_like(angle), angle)


def _far_shift(
    sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor], signal: Tensor, weight: Tensor
) -> Tensor:
    """Displacements [B, 2] with which pictures correlate best with what is measured; 0 where that is as good."""
    mean = _sum(weight * signal) / _sum(weight).clamp(min=1e-30)
    contrast = weight * (signal - mean[:, None, None].to(signal.dtype))
    with torch.enable_grad():
        # Reading is linear, so its derivative brings what is measured to where the spectrum is.
        at_rest = spectrum.detach().requires_grad_()
        (brought,) = torch.autograd.grad((contrast * _on_sensor(sensor, read(at_rest))).sum(), at_rest)
    tried = torch.as_tensor(TRIED_SHIFTS, dtype=sensor.iy.dtype)
    down, across = (_phasors(tried[:, None] * f) for f in (sensor.iy.mT, sensor.ix))
    loss = NEARER * (tried / tried[-1]) ** 2 / 2
    correlation = (down @ (brought.conj() * spectrum) @ across.mT).real
    correlation = (correlation * (1 - loss[:, None] - loss)).flatten(1)
    highest, place = correlation.max(1)
    best = torch.stack([tried[place // len(tried)], tried[place % len(tried)]], 1)
    at_zero = correlation[:, correlation.shape[1] // 2]
    return torch.where((at_zero >= BLIND * highest)[:, None], torch.zeros_like(best), best)


def _step(
    sensor: Sensor, spectrum: Tensor, read: Callable[[Tensor], Tensor], signal: Tensor, weight: Tensor
) -> Tensor:
    """Displacements [B, 2] that fit the pictures better, each with a brightness of its own."""
    observed, weight = signal.flatten(1).double(), weight.flatten(1).double()
    columns = [read(spectrum)]
    columns += [read(spectrum * (2j * math.pi * f)) for f in (sensor.iy, sensor.ix)]
    stacked = torch.stack([_on_sensor(sensor, c) for c in columns], 1).flatten(2).double()
    weighted = stacked * weight[:, None]
    normal = weighted @ stacked.mT
    normal = normal + 1e-9 * torch.diag_embed(torch.diagonal(normal, dim1=-2, dim2=-1) + 1e-30)
    found = torch.linalg.solve(normal, (weighted @ observed[:, :, None])[..., 0])
    step = found[:, 1:] / torch.where(found[:, :1].abs() < 1e-30, torch.ones_like(found[:, :1]), found[:, :1])
    return torch.clamp(step, -MOST, MOST).to(sensor.iy.dtype)
