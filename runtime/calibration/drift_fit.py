"""The fit of what drifts to captures: damped Gauss-Newton on residuals weighted by the camera's noise.

Derivatives over wavefront, beam and distance are the light path's own linearisation, 2 Re(z* dz); those of
the camera's view cost no propagation. Each capture's gain follows in closed form (its columns are taken with
the gain projected out), so laser power may wander while patterns are shown. Orders rise in steps: low ones
find the way from far, high ones then need to go only a little.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from runtime.calibration.drift import Drift, amplitude_maps, axial_phase, drifted, wavefront_maps
from runtime.camera.view import TERMS, Sampler, View, sampler, sensitivity_maps
from runtime.lightpath.light_path import (
    LightPath,
    filter_irradiance,
    image_field,
    irradiance,
    panel_phase,
    panel_spectrum,
)

# What is thought possible before anything is seen, as standard deviations; keeps what no light shows at rest.
LIKELY = {"wavefront": 1000.0, "amplitude": 1.0, "distance": 5.0, "view": 3.0}
LIKELY_STRETCH = 0.01  # of a homography that dots gave
SHARPEST = -0.05  # square pixels: a lens cannot sharpen; this much is room for noise
HELD = 1e30  # precision of what is not to move
VIEW = (
    ("shift_y_px", 0.02),
    ("shift_x_px", 0.02),
    ("rotation_mrad", 0.05),
    ("distortion", 1e-3),
    ("blur_y_px2", 0.02),
    ("blur_x_px2", 0.02),
)  # fields of a View and the steps of their secants
STRETCH = tuple((name, 1e-3) for name in ("magnification", "aspect", "shear", "keystone_y", "keystone_x"))
SETTLED = 0.3  # a step that lowers chi squared by less, per parameter, is the last

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Base:
    """A colour's light path as the bundle has it, and its wavelength."""

    path: LightPath
    wavelength_nm: float


@dataclass(frozen=True)
class Shot:
    """One capture. gray: uint8 [H, W]. signal: counts above black, float32 [h, w]. weight: 1 / variance of its
    noise, 0 where saturated.
    """

    channel: str
    gray: np.ndarray
    signal: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Estimate:
    """What is believed of a headset: its light's drift, and its camera's view."""

    drift: Drift
    view: View


@dataclass(frozen=True)
class Fitted:
    """A fitted estimate. errors: standard errors of its drift, in its own shape. chi2: of what was seen, per
    pixel; 1 is the camera's noise alone.
    """

    estimate: Estimate
    errors: Drift
    chi2: float


def predicted(base: Base, shot: Shot, estimate: Estimate, sample: Sampler) -> np.ndarray:
    """Counts above black a unit of gain, float32 [h, w]: stray light in, gain out."""
    path = drifted(base.path, shot.channel, base.wavelength_nm, estimate.drift)
    image = irradiance(path, panel_phase(path, shot.gray.astype(np.int64)))
    return seen_by(estimate.view, sample, image)


def seen_by(view: View, sample: Sampler, image: np.ndarray) -> np.ndarray:
    """What a camera makes of fine irradiance, up to a gain: float32 [h, w]."""
    light = sample(image)
    return (light * view.evenness() + view.stray * float(light.mean())).astype(np.float32)


def gain_of(shot: Shot, light: np.ndarray) -> float:
    """The factor on a prediction that brings it nearest to a capture."""
    return float(np.vdot(shot.weight * light, shot.signal)) / max(
        float(np.vdot(shot.weight * light, light)), 1e-30
    )


def chi_squared(
    bases: Mapping[str, Base], shots: Sequence[Shot], estimate: Estimate, finer: int = 2
) -> float:
    """Sum of squared residuals over their noise's variance, gains fitted."""
    total = 0.0
    samplers = _samplers(bases, estimate.view, finer)
    for shot in shots:
        light = predicted(bases[shot.channel], shot, estimate, samplers[shot.channel])
        residual = shot.signal - gain_of(shot, light) * light
        total += float(np.vdot(shot.weight * residual, residual))
    return total


def fit(
    bases: Mapping[str, Base],
    shots: Sequence[Shot],
    start: Estimate,
    orders: tuple[int, int],
    iterations: int = 4,
    new_view: bool = False,
    progress: Progress | None = None,
) -> Fitted:
    """The estimate that explains the shots best, from `start` on, with Legendre terms up to two orders.

    orders: of the wavefront, and of the beam's amplitude; (0, 0) fits the camera's view alone. The response is
    held. new_view: the view's homography is as good as dots are, so that its stretch is fitted along. progress:
    share done.
    """
    layout = _Layout(tuple(bases), *orders, VIEW + STRETCH if new_view else VIEW)
    estimate = layout.widened(start)
    cost = chi_squared(bases, shots, estimate) + layout.prior(estimate)
    damping = 1e-3
    for iteration in range(iterations):
        told = _told(progress, iteration, iterations)
        normal, gradient = _normal_equations(bases, shots, estimate, layout, told)
        normal += np.diag(layout.precision)
        gradient -= layout.precision * layout.numbers(estimate)
        decrease = 0.0
        for _ in range(6):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            trial = layout.moved(estimate, step)
            trial_cost = chi_squared(bases, shots, trial) + layout.prior(trial)
            if trial_cost < cost:
                estimate, decrease, cost = trial, cost - trial_cost, trial_cost
                damping = max(damping / 10, 1e-8)
                break
            damping = max(10 * damping, 1e-3)
        if decrease < SETTLED * len(step):
            break
    pixels = sum(int(np.count_nonzero(s.weight)) for s in shots)
    chi2 = cost / max(pixels, 1)
    # a misfit widens the errors: residuals are then no longer the camera's noise
    spread = np.sqrt(np.diag(np.linalg.inv(normal)) * max(1.0, chi2))
    zero = layout.moved(layout.nothing(start), np.zeros(len(spread)))
    return Fitted(estimate, layout.moved(zero, spread).drift, chi2)


def _told(progress: Progress | None, iteration: int, iterations: int) -> Progress:
    return (lambda done: progress((iteration + done) / iterations)) if progress else (lambda done: None)


def _samplers(bases: Mapping[str, Base], view: View, finer: int) -> dict[str, Sampler]:
    """One for each colour; colours on one grid share theirs."""
    made: dict[object, Sampler] = {}
    for base in bases.values():
        if base.path.grid not in made:
            made[base.path.grid] = sampler(view, base.path.grid, finer)
    return {name: made[base.path.grid] for name, base in bases.items()}


class _Layout:
    """Where each number of an estimate stands in the vector that is fitted."""

    def __init__(
        self,
        channels: tuple[str, ...],
        wavefront: int,
        amplitude: int,
        view: tuple[tuple[str, float], ...] = VIEW,
    ) -> None:
        shape = (1, 1)
        self.channels, self.view = channels, view
        self.orders = (wavefront, amplitude)
        self.wavefront = len(wavefront_maps(shape, wavefront)) if wavefront >= 2 else 0
        self.amplitude = len(amplitude_maps(shape, amplitude)) if amplitude >= 1 else 0
        sizes = [self.wavefront, self.amplitude * len(channels), 1, len(view) + TERMS + 1]
        self.edges = np.cumsum([0, *sizes])
        spread = [np.full(n, LIKELY[k]) for n, k in zip(sizes, LIKELY, strict=True)]
        self.precision = 1 / np.concatenate(spread) ** 2
        self.precision[self.edges[3] + len(VIEW) :][: len(view) - len(VIEW)] = 1 / LIKELY_STRETCH**2
        if not any(self.orders):
            self.precision[self.edges[2]] = HELD

    def numbers(self, estimate: Estimate) -> np.ndarray:
        """The vector of an estimate."""
        drift, view = estimate.drift, estimate.view
        beams = [drift.log_amplitude[c] for c in self.channels]
        seen = [getattr(view, name) for name, _ in self.view]
        parts = [drift.wavefront_nm, *beams, [drift.distance_mm], seen, view.sensitivity, [view.stray]]
        return np.concatenate([np.asarray(p, float) for p in parts])

    def moved(self, estimate: Estimate, step: np.ndarray) -> Estimate:
        """An estimate with a vector added to its numbers."""
        vector = self.numbers(estimate) + step
        wavefront, beams, distance, seen = (
            vector[a:b] for a, b in zip(self.edges[:-1], self.edges[1:], strict=True)
        )
        split = beams.reshape(len(self.channels), self.amplitude)
        drift = replace(
            estimate.drift,
            wavefront_nm=wavefront,
            log_amplitude=dict(zip(self.channels, split, strict=True)),
            distance_mm=float(distance[0]),
        )
        values: dict[str, Any] = dict(zip((name for name, _ in self.view), map(float, seen), strict=False))
        for name in ("blur_y_px2", "blur_x_px2"):
            values[name] = max(values[name], SHARPEST)
        sensitivity = tuple(float(v) for v in seen[len(self.view) : -1])
        view = replace(estimate.view, sensitivity=sensitivity, stray=float(seen[-1]), **values)
        return Estimate(drift, view)

    def widened(self, estimate: Estimate) -> Estimate:
        """An estimate with as many terms as are to be fitted: further ones 0."""
        drift = estimate.drift
        beams = {c: _sized(drift.log_amplitude.get(c, np.zeros(0)), self.amplitude) for c in self.channels}
        wavefront = _sized(drift.wavefront_nm, self.wavefront)
        return replace(estimate, drift=replace(drift, wavefront_nm=wavefront, log_amplitude=beams))

    def nothing(self, estimate: Estimate) -> Estimate:
        """An estimate that says that nothing has drifted."""
        return self.widened(Estimate(Drift(), View(estimate.view.shape)))

    def prior(self, estimate: Estimate) -> float:
        """What it costs to be unlikely."""
        return float(np.sum(self.precision * self.numbers(estimate) ** 2))


def _sized(terms: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([terms, np.zeros(max(0, count - len(terms)))])[:count]


def _normal_equations(
    bases: Mapping[str, Base],
    shots: Sequence[Shot],
    estimate: Estimate,
    layout: _Layout,
    told: Progress,
) -> tuple[np.ndarray, np.ndarray]:
    """The Fisher information matrix and the gradient of half chi squared, over the layout's numbers."""
    count = int(layout.edges[-1])
    normal, gradient = np.zeros((count, count)), np.zeros(count)
    samplers = _samplers(bases, estimate.view, 2)
    rough = _samplers(bases, estimate.view, 1)
    views = _stepped_views(bases, estimate.view, layout.view)
    for number, shot in enumerate(shots):
        base = bases[shot.channel]
        light = predicted(base, shot, estimate, samplers[shot.channel])
        gain, root = gain_of(shot, light), np.sqrt(shot.weight)
        residual = (root * (shot.signal - gain * light)).ravel()
        along = (root * light).ravel()
        along /= max(math.sqrt(float(np.vdot(along, along))), 1e-30)
        rows = np.zeros((count, residual.size), np.float32)
        for place, column in _columns(base, shot, estimate, layout, rough[shot.channel], views):
            rows[place] = (root * gain * column).ravel()
        rows -= np.outer(rows @ along, along)
        normal += rows @ rows.T
        gradient += rows @ residual
        told((number + 1) / len(shots))
    return normal, gradient


def _stepped_views(
    bases: Mapping[str, Base], view: View, steps: tuple[tuple[str, float], ...] = VIEW
) -> list[tuple[float, dict[str, Sampler]]]:
    """For each fitted field of a view, the step of its secant and what samples light after it; the first
    entry is without a step.
    """
    moved = [replace(view, **{name: getattr(view, name) + step}) for name, step in steps]
    return [(0.0, _samplers(bases, view, 1))] + [
        (step, _samplers(bases, one, 1)) for (_, step), one in zip(steps, moved, strict=True)
    ]


def _columns(
    base: Base,
    shot: Shot,
    estimate: Estimate,
    layout: _Layout,
    sample: Sampler,
    views: list[tuple[float, dict[str, Sampler]]],
) -> Iterator[tuple[int, np.ndarray]]:
    """Derivatives of a prediction, [h, w], with the place of each in the vector."""
    path = drifted(base.path, shot.channel, base.wavelength_nm, estimate.drift)
    phase = panel_phase(path, shot.gray.astype(np.int64))
    spectrum = panel_spectrum(path, phase)
    modes = range(path.transfers.shape[0])
    fields = [image_field(path, spectrum, m) for m in modes]
    even = estimate.view.evenness().astype(np.float32)

    def change(moved: Callable[[int], np.ndarray]) -> np.ndarray:
        """2 Re(z* dz) summed over modes, as the camera sees it; `moved` gives a mode's dz."""
        total = sum(
            float(path.weights[m]) * 2 * (z.real * d.real + z.imag * d.imag)
            for m, z, d in ((m, fields[m], moved(m)) for m in modes)
        )
        light = sample(filter_irradiance(path, np.asarray(total)))
        return light * even + estimate.view.stray * light.mean()

    def over_panel(factor: np.ndarray) -> np.ndarray:
        """For a relative change [H, W] of the field that leaves the panel."""
        factor = factor.astype(path.source.dtype)
        leak = None if path.leak is None else path.leak * factor
        moved = panel_spectrum(replace(path, source=path.source * factor, leak=leak), phase)
        return change(lambda m: image_field(path, moved, m))

    shape, place = path.grid.shape, int(layout.edges[1])
    if layout.wavefront:
        for k, one in enumerate(wavefront_maps(shape, layout.orders[0])):
            yield k, over_panel(2j * math.pi / base.wavelength_nm * one)
    if layout.amplitude:
        place += layout.channels.index(shot.channel) * layout.amplitude
        for k, one in enumerate(amplitude_maps(shape, layout.orders[1])):
            yield place + k, over_panel(one)
    place = int(layout.edges[2])
    turned = path.transfers * (1j * axial_phase(path, base.wavelength_nm)).astype(path.transfers.dtype)
    away = replace(path, transfers=turned)
    yield place, change(lambda m: image_field(away, spectrum, m))

    image = filter_irradiance(
        path, np.asarray(sum(float(path.weights[m]) * np.abs(fields[m]) ** 2 for m in modes), np.float32)
    )
    place = int(layout.edges[3])
    light = views[0][1][shot.channel](image)
    for k, (step, samplers) in enumerate(views[1:]):
        yield place + k, (samplers[shot.channel](image) - light) / step * even
    for k, one in enumerate(sensitivity_maps(estimate.view.shape)):
        yield place + len(layout.view) + k, light * even * one
    yield place + len(layout.view) + TERMS, np.full(light.shape, light.mean(), np.float32)
