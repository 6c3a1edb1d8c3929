"""The fit of what drifts to captures: damped Gauss-Newton on residuals weighted by the camera's noise.

Derivatives over wavefront, beam and distance are the light path's own linearisation, 2 Re(z* dz); those of
the camera's view cost no propagation. Each capture's gain follows in closed form (its columns are taken with
the gain projected out), so laser power may change while patterns are shown. Orders rise in steps: low ones
find the way from far, high ones then need to go only a little.

The trainer has a Gauss-Newton fit of its own (`trainer/fitting/gauss_newton.py`). The two stay two on purpose.
The headset has no torch; it weights residuals by the camera's noise and differentiates the bundle's baked arrays.
The trainer minimises the unweighted excess that it reports, by secants of effects, whatever an effect does inside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from runtime.calibration.drift import Drift, amplitude_maps, axial_phase, drifted, wavefront_maps
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, gain_of, predicted
from runtime.calibration.parameter_layout import STRETCH, VIEW, ParameterLayout
from runtime.camera.view import TERMS, Sampler, View, sampler, sensitivity_maps
from runtime.lightpath.light_path import (
    filter_irradiance,
    image_field,
    panel_phase,
    panel_spectrum,
    states,
)
from runtime.program.progress import Progress, no_progress, part_of

SETTLED = 0.3  # a step that lowers chi squared by less, per parameter, is the last


@dataclass(frozen=True)
class DriftFit:
    """A fitted estimate.

    Attributes
    ----------
    estimate : Estimate
    errors : Drift
        Standard errors of the estimate's drift, in its own shape.
    chi2 : float
        Per pixel that counts; 1 is the camera's noise alone.
    """

    estimate: Estimate
    errors: Drift
    chi2: float


def chi_squared(
    bases: Mapping[str, ColourLightPath], shots: Sequence[Shot], estimate: Estimate, finer: int = 2
) -> float:
    """Sum of squared residuals over their noise's variance, each shot with its own best gain.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    shots : sequence of Shot
    estimate : Estimate
    finer : int
        Of the camera's `sampler`.
    """
    total = 0.0
    samplers = _samplers(bases, estimate.view, finer)
    for shot in shots:
        light = predicted(bases[shot.channel], shot, estimate, samplers[shot.channel])
        residual = shot.signal - gain_of(shot, light) * light
        total += float(np.vdot(shot.weight * residual, residual))
    return total


def fit(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    start: Estimate,
    orders: tuple[int, int],
    iterations: int = 4,
    new_view: bool = False,
    progress: Progress | None = None,
) -> DriftFit:
    """The estimate that explains the shots best. The response is held.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    shots : sequence of Shot
    start : Estimate
    orders : (int, int)
        Highest Legendre orders of the wavefront and of the beam's amplitude; (0, 0) fits the camera's view alone.
    iterations : int
        At most.
    new_view : bool
        Whether the view's homography is only as good as dots are: its stretch is then fitted too.
    progress : callable, optional
        Called with the share done, 0 to 1.

    Returns
    -------
    DriftFit
    """
    layout = ParameterLayout(tuple(bases), *orders, VIEW + STRETCH if new_view else VIEW)
    estimate = layout.widened(start)
    cost = chi_squared(bases, shots, estimate) + layout.prior(estimate)
    damping = 1e-3
    for iteration in range(iterations):
        share = _share_of(progress, iteration, iterations)
        normal, gradient = _normal_equations(bases, shots, estimate, layout, share)
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
    return DriftFit(estimate, layout.moved(zero, spread).drift, chi2)


def _share_of(progress: Progress | None, iteration: int, iterations: int) -> Progress:
    """Progress of one iteration as progress of the whole fit."""
    return part_of(progress or no_progress, iteration / iterations, (iteration + 1) / iterations)


def _samplers(bases: Mapping[str, ColourLightPath], view: View, finer: int) -> dict[str, Sampler]:
    """One for each colour; colours on one grid share theirs."""
    made: dict[object, Sampler] = {}
    for base in bases.values():
        if base.path.grid not in made:
            made[base.path.grid] = sampler(view, base.path.grid, finer)
    return {name: made[base.path.grid] for name, base in bases.items()}


def _normal_equations(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    estimate: Estimate,
    layout: ParameterLayout,
    progress: Progress,
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
        progress((number + 1) / len(shots))
    return normal, gradient


def _stepped_views(
    bases: Mapping[str, ColourLightPath], view: View, steps: tuple[tuple[str, float], ...] = VIEW
) -> list[tuple[float, dict[str, Sampler]]]:
    """The step of each fitted field's secant, and the samplers after it; the first entry is without a step."""
    moved = [replace(view, **{name: getattr(view, name) + step}) for name, step in steps]
    return [(0.0, _samplers(bases, view, 1))] + [
        (step, _samplers(bases, one, 1)) for (_, step), one in zip(steps, moved, strict=True)
    ]


def _columns(
    base: ColourLightPath,
    shot: Shot,
    estimate: Estimate,
    layout: ParameterLayout,
    sample: Sampler,
    views: list[tuple[float, dict[str, Sampler]]],
) -> Iterator[tuple[int, np.ndarray]]:
    """Derivatives of a prediction, [h, w], with the place of each in the vector."""
    path = drifted(base.path, shot.channel, base.wavelength_nm, estimate.drift)
    phase = panel_phase(path, shot.gray.astype(np.int64))
    exposure = list(states(path))  # the panel's states, whose irradiances add
    spectra = [panel_spectrum(state, phase) for state in exposure]
    parts = [(k, m) for k in range(len(exposure)) for m in range(path.transfers.shape[0])]
    weights = [float(exposure[k].weights[m]) for k, m in parts]
    fields = [image_field(path, spectra[k], m) for k, m in parts]
    even = estimate.view.evenness().astype(np.float32)

    def change(moved: Callable[[int, int], np.ndarray]) -> np.ndarray:
        """2 Re(z* dz) summed over states and modes, as the camera sees it; `moved` gives the dz of both."""
        total = sum(
            w * 2 * (z.real * d.real + z.imag * d.imag)
            for w, z, d in ((w, z, moved(*part)) for w, z, part in zip(weights, fields, parts, strict=True))
        )
        light = sample(filter_irradiance(path, np.asarray(total)))
        return light * even + estimate.view.stray * light.mean()

    def over_panel(factor: np.ndarray) -> np.ndarray:
        """For a relative change [H, W] of the field that leaves the panel."""
        factor = factor.astype(path.source.dtype)
        leak = None if path.leak is None else path.leak * factor
        moved = [
            panel_spectrum(replace(one, source=one.source * factor, leak=leak), phase) for one in exposure
        ]
        return change(lambda k, m: image_field(path, moved[k], m))

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
    yield place, change(lambda k, m: image_field(away, spectra[k], m))

    image = filter_irradiance(
        path,
        np.asarray(sum(w * np.abs(z) ** 2 for w, z in zip(weights, fields, strict=True)), np.float32),
    )
    place = int(layout.edges[3])
    light = views[0][1][shot.channel](image)
    for k, (step, samplers) in enumerate(views[1:]):
        yield place + k, (samplers[shot.channel](image) - light) / step * even
    for k, one in enumerate(sensitivity_maps(estimate.view.shape)):
        yield place + len(layout.view) + k, light * even * one
    yield place + len(layout.view) + TERMS, np.full(light.shape, light.mean(), np.float32)
