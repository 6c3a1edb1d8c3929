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
from scipy.linalg import solve_triangular
from scipy.optimize import OptimizeResult, minimize

from runtime.calibration.drift import LOWEST_AMPLITUDE, LOWEST_WAVEFRONT, Drift, axial_phase, drifted
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, gain_of, predicted
from runtime.calibration.misfit import Misfit
from runtime.calibration.parameter_layout import STRETCH, VIEW, ParameterLayout
from runtime.camera.view import TERMS, Sampler, View, sampler, sensitivity_maps
from runtime.lightpath.legendre import legendre_map_by_map
from runtime.lightpath.light_path import (
    filter_irradiance,
    image_field,
    panel_phase,
    panel_spectrum,
    states,
)
from runtime.program.progress import Progress, no_progress, part_of

SETTLED = 0.3  # a step that lowers chi squared by less, per parameter, is the last
SAMPLE = 250_000  # pixels of a colour that the normal matrix is made from: thousands for each number


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
    iterations: int = 8,
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
    share = part_of(progress or no_progress, 0.0, 0.5)
    normal = _normal_matrix(bases, shots, estimate, layout, share) + np.diag(layout.precision)
    estimate, cost = _descended(bases, shots, estimate, layout, normal, iterations, progress or no_progress)
    pixels = sum(int(np.count_nonzero(s.weight)) for s in shots)
    chi2 = cost / max(pixels, 1)
    # a misfit widens the errors: residuals are then no longer the camera's noise
    spread = np.sqrt(np.diag(np.linalg.inv(normal)) * max(1.0, chi2))
    zero = layout.moved(layout.nothing(start), np.zeros(len(spread)))
    return DriftFit(estimate, layout.moved(zero, spread).drift, chi2)


def _descended(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    start: Estimate,
    layout: ParameterLayout,
    normal: np.ndarray,
    iterations: int,
    progress: Progress,
) -> tuple[Estimate, float]:
    """The estimate of least cost, and that cost: BFGS on numbers that the normal matrix makes alike.

    In those numbers the cost is nearly a sphere, and is scaled so that the first step is the Gauss-Newton step.
    """
    misfit = Misfit(bases, shots)
    wavelengths = {c: b.wavelength_nm for c, b in bases.items()}
    levers = layout.levers(start.view, next(iter(bases.values())).path.grid.shape)
    upper = np.linalg.cholesky(normal).T

    def cost_at(estimate: Estimate) -> tuple[float, np.ndarray]:
        """Half the cost, and its gradient over the whitened numbers."""
        chi2, slopes = misfit.at(estimate)
        gradient = layout.gradient(slopes, wavelengths, levers) / 2
        gradient += layout.precision * layout.numbers(estimate)
        half = (chi2 + layout.prior(estimate)) / 2
        return half, solve_triangular(upper, gradient, trans=1)

    first, downhill = cost_at(start)
    scale = max(float(np.linalg.norm(downhill)), 1e-30)
    best = [first, start]
    done, least = 0, first

    def scaled(step: np.ndarray) -> tuple[float, np.ndarray]:
        if not step.any():
            return first / scale**2, downhill / scale
        estimate = layout.moved(start, solve_triangular(upper, scale * step))
        half, gradient = cost_at(estimate)
        if half < best[0]:
            best[:] = half, estimate
        return half / scale**2, gradient / scale

    def after_iteration(intermediate_result: OptimizeResult) -> None:
        nonlocal done, least
        done += 1
        progress(0.5 + 0.5 * done / iterations)
        decrease, least = least - best[0], best[0]
        if 2 * decrease < SETTLED * len(downhill):
            raise StopIteration

    minimize(
        scaled, np.zeros(len(downhill)), jac=True, method="L-BFGS-B", callback=after_iteration,
        options={"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": iterations, "ftol": 0, "gtol": 0},
    )  # fmt: skip
    return best[1], 2 * best[0]


def _samplers(bases: Mapping[str, ColourLightPath], view: View, finer: int) -> dict[str, Sampler]:
    """One for each colour; colours on one grid share theirs."""
    made: dict[object, Sampler] = {}
    for base in bases.values():
        if base.path.grid not in made:
            made[base.path.grid] = sampler(view, base.path.grid, finer)
    return {name: made[base.path.grid] for name, base in bases.items()}


def _normal_matrix(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    estimate: Estimate,
    layout: ParameterLayout,
    progress: Progress,
) -> np.ndarray:
    """The Fisher information matrix over the layout's numbers, from a sample of the pixels."""
    count = int(layout.edges[-1])
    normal = np.zeros((count, count))
    samplers = _samplers(bases, estimate.view, 2)
    rough = _samplers(bases, estimate.view, 1)
    views = _stepped_views(bases, estimate.view, layout.view)
    chosen = _sample(shots)
    for number, (shot, pixels, share) in enumerate(chosen):
        base = bases[shot.channel]
        light = predicted(base, shot, estimate, samplers[shot.channel])
        gain, root = gain_of(shot, light), np.sqrt(shot.weight).ravel()[pixels]
        along = root * light.ravel()[pixels]
        along /= max(math.sqrt(float(np.vdot(along, along))), 1e-30)
        rows = np.zeros((count, along.size), np.float32)
        for place, column in _columns(base, shot, estimate, layout, rough[shot.channel], views):
            rows[place] = root * gain * column.ravel()[pixels]
        rows -= np.outer(rows @ along, along)
        normal += (rows @ rows.T) / share
        progress((number + 1) / len(chosen))
    return normal


def _sample(shots: Sequence[Shot]) -> list[tuple[Shot, np.ndarray | slice, float]]:
    """Shots with the pixels to sample of each (all, or chosen at random), and which share of the colour's all they are.

    Every pixel of every pattern where there are few; else of as few patterns as will do, since each costs a propagation
    a number.
    """
    chosen: list[tuple[Shot, np.ndarray | slice, float]] = []
    rng = np.random.default_rng(0)
    for channel in dict.fromkeys(shot.channel for shot in shots):
        own = [shot for shot in shots if shot.channel == channel]
        size = own[0].signal.size
        some = own[: max(1, math.ceil(SAMPLE / size))]
        each = min(size, math.ceil(SAMPLE / len(some)))
        for shot in some:
            pixels = slice(None) if each == size else np.sort(rng.choice(size, each, replace=False))
            chosen.append((shot, pixels, len(some) * each / (len(own) * size)))
    return chosen


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
        turn = np.complex64(2j * math.pi / base.wavelength_nm)
        for k, one in enumerate(legendre_map_by_map(shape, layout.orders[0], LOWEST_WAVEFRONT)):
            yield k, over_panel(turn * one)
    if layout.amplitude:
        place += layout.channels.index(shot.channel) * layout.amplitude
        for k, one in enumerate(legendre_map_by_map(shape, layout.orders[1], LOWEST_AMPLITUDE)):
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
