"""The fit of what drifts to captures, on residuals weighted by the camera's noise.

Its slopes come by the adjoint, from every pixel of every capture, for the price of one pass forward and one back a
capture, however many numbers are fitted. A Gauss-Newton matrix from a sample of the pixels makes the numbers alike, and
BFGS goes on from there. Each capture's gain follows in closed form, so laser power may change while patterns are shown.
Orders rise in steps: low ones find the way from far, high ones then need to go only a little.

The trainer has a Gauss-Newton fit of its own (`trainer/fitting/gauss_newton.py`). The two stay two on purpose.
The headset has no torch; it weights residuals by the camera's noise and differentiates the bundle's baked arrays.
The trainer minimises the unweighted excess that it reports, by secants of effects, whatever an effect does inside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import OptimizeResult, minimize

from runtime.calibration.drift import Drift
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, gain_of
from runtime.calibration.information import Information, measured_information
from runtime.calibration.misfit import Misfit
from runtime.calibration.parameter_layout import STRETCH, VIEW, ParameterLayout
from runtime.calibration.prediction import Predictor
from runtime.program.progress import Progress, no_progress, part_of

SETTLED = 0.3  # a step that lowers chi squared by less, per parameter, is the last
SETTLED_SHARE = 1e-3  # or by a smaller share
ROUNDS = 3  # of descents: where one does not settle, the information is measured anew, nearer to the truth


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
    information : Information
        That the fit went by.
    """

    estimate: Estimate
    errors: Drift
    chi2: float
    information: Information


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
    predictor = Predictor(bases, finer)
    predictor.take(estimate)
    return predicted_chi_squared(predictor, shots)


def predicted_chi_squared(predictor: Predictor, shots: Sequence[Shot]) -> float:
    """`chi_squared` of what a predictor has taken."""
    total = 0.0
    for shot in shots:
        light = predictor.light(shot)
        residual = shot.signal - np.float32(gain_of(shot, light)) * light
        total += float(np.vdot(shot.weight * residual, residual))
    return total


def fit(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    start: Estimate,
    orders: tuple[int, int],
    iterations: int = 6,
    new_view: bool = False,
    progress: Progress | None = None,
    information: Information | None = None,
    rounds: int = ROUNDS,
    settled_share: float = SETTLED_SHARE,
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
        A round, at most.
    new_view : bool
        Whether the view's homography is only as good as dots are: its stretch is then fitted too.
    progress : callable, optional
        Called with the share done, 0 to 1.
    information : Information, optional
        Of an estimate like this one, of these orders or higher, for the first round; None: it is measured at the start.
    rounds : int
        At most.
    settled_share : float
        An iteration that lowers the cost by a smaller share is the last.

    Returns
    -------
    DriftFit
    """
    layout = layout_of(bases, orders, new_view)
    estimate = layout.widened(start)
    progress = progress or no_progress
    for number in range(rounds):
        share = part_of(progress, number / rounds, (number + 1) / rounds)
        first_half = part_of(share, 0.0, 0.5)
        known = information if number == 0 else None
        used = known or measured_information(bases, shots, estimate, layout, first_half)
        normal = len(shots) * used.of(layout) + np.diag(layout.precision)
        estimate, cost, settled = _descended(
            bases, shots, estimate, layout, normal, iterations, settled_share, share
        )
        if settled:
            break
    pixels = sum(int(np.count_nonzero(s.weight)) for s in shots)
    chi2 = cost / max(pixels, 1)
    # a misfit widens the errors: residuals are then no longer the camera's noise
    spread = np.sqrt(np.diag(np.linalg.inv(normal)) * max(1.0, chi2))
    zero = layout.moved(layout.nothing(start), np.zeros(len(spread)))
    return DriftFit(estimate, layout.moved(zero, spread).drift, chi2, used)


def layout_of(
    bases: Mapping[str, ColourLightPath], orders: tuple[int, int], new_view: bool
) -> ParameterLayout:
    """The layout of a fit; the arguments are those of `fit`."""
    return ParameterLayout(tuple(bases), *orders, VIEW + STRETCH if new_view else VIEW)


def _descended(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    start: Estimate,
    layout: ParameterLayout,
    normal: np.ndarray,
    iterations: int,
    settled_share: float,
    progress: Progress,
) -> tuple[Estimate, float, bool]:
    """The estimate of least cost, that cost, and whether it has settled: BFGS on numbers that `normal` makes alike.

    In those numbers the cost is nearly a sphere, and is scaled so that the first step is the Gauss-Newton step.
    """
    misfit = Misfit(bases, shots, light=any(layout.orders))
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
    lowest, best = first, start
    done, least, settled = 0, first, False

    def scaled(step: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal lowest, best
        if not step.any():
            return first / scale**2, downhill / scale
        estimate = layout.moved(start, solve_triangular(upper, scale * step))
        half, gradient = cost_at(estimate)
        if half < lowest:
            lowest, best = half, estimate
        return half / scale**2, gradient / scale

    def after_iteration(intermediate_result: OptimizeResult) -> None:
        nonlocal done, least, settled
        done += 1
        progress(0.5 + 0.5 * done / iterations)
        decrease, least = least - lowest, lowest
        settled = decrease < max(SETTLED * len(downhill) / 2, settled_share * least)
        if settled:
            raise StopIteration

    minimize(
        scaled, np.zeros(len(downhill)), jac=True, method="L-BFGS-B", callback=after_iteration,
        options={"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": iterations, "ftol": 0, "gtol": 0},
    )  # fmt: skip
    return best, 2 * lowest, settled
