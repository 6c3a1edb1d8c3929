"""Free-form maps over the panel: what is left of wavefront and beam after the polynomials.

A real panel and its beam have structure that polynomials do not follow. Maps of cubic B-splines are fitted to the same
captures by L-BFGS (Liu and Nocedal 1989), with the light path's own adjoint, from coarse nodes to fine ones. A capture
gives one measurement a pixel, and the finest map has one number every 4 x 4 pixels, so ten patterns determine it
some 160 times over. A weak prior holds what no light shows, and few iterations keep the rest from following noise.
Time and memory grow only with the number of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from runtime.calibration.estimate import ColourLightPath, Estimate, Shot
from runtime.calibration.misfit import Misfit
from runtime.lightpath.spline_maps import node_weights, nodes_over, on_other_nodes
from runtime.program.progress import Progress

FINEST = 4.0  # panel pixels between nodes
COARSEST = 1 / 24  # of the panel's shorter side
LIKELY_NM, LIKELY_LOG = 30.0, 0.3  # standard deviations of a node, before any capture
ITERATIONS, FEWEST = 30, 10
WORK = 25_000_000  # pixels predicted in a fit: small panels alone get more iterations than that takes
SETTLED = 1e-6  # an iteration that lowers chi squared by a smaller share is the last
MEMORY = 8  # steps that L-BFGS remembers


def fit_freeform(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    start: Estimate,
    progress: Progress | None = None,
    spacing: float = FINEST,
) -> Estimate:
    """The estimate with maps of wavefront and beam that explain the shots best, all else held.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    shots : sequence of Shot
    start : Estimate
    progress : callable, optional
        Called with the share done, 0 to 1.
    spacing : float, panel pixels
        Between nodes. What maps the start has on other nodes goes on on these.

    Returns
    -------
    Estimate
        Its drift has one map of the wavefront for all colours, and one of the beam for each colour.
    """
    shape = next(iter(bases.values())).path.grid.shape
    nodes = nodes_over(shape, spacing)
    rows, columns = (node_weights(n, m).astype(np.float32) for n, m in zip(shape, nodes, strict=True))
    channels = tuple(bases)
    misfit = Misfit(bases, shots, motion=False)
    done, least, iterations = 0, math.inf, iterations_over(shots)

    def with_maps(vector: np.ndarray) -> Estimate:
        nm, *logs = vector.reshape(-1, *nodes)
        beams = {c: LIKELY_LOG * v for c, v in zip(channels, logs, strict=True)}
        return replace(
            start, drift=replace(start.drift, wavefront_nodes_nm=LIKELY_NM * nm, amplitude_nodes=beams)
        )

    def cost(vector: np.ndarray) -> tuple[float, np.ndarray]:
        chi2, slopes = misfit.at(with_maps(vector))
        gradient = 2 * vector.reshape(-1, *nodes)
        for number, (channel, over) in enumerate(slopes.over_panel.items(), 1):
            turn = 2 * math.pi / bases[channel].wavelength_nm * LIKELY_NM
            gradient[0] += turn * (rows.T @ over.imag @ columns)
            gradient[number] += LIKELY_LOG * (rows.T @ over.real @ columns)
        return float(vector @ vector) + chi2, gradient.ravel()

    def after_iteration(intermediate_result: OptimizeResult) -> None:
        nonlocal done, least
        done += 1
        if progress:
            progress(done / iterations)
        decrease, least = least - intermediate_result.fun, intermediate_result.fun
        if decrease < SETTLED * least:
            raise StopIteration

    drift, none = start.drift, np.zeros((0, 0))
    begin = [drift.wavefront_nodes_nm / LIKELY_NM]
    begin += [drift.amplitude_nodes.get(c, none) / LIKELY_LOG for c in channels]
    vector = np.ravel([on_other_nodes(m, nodes, shape) if m.size else np.zeros(nodes) for m in begin])
    found = minimize(
        cost, vector, jac=True, method="L-BFGS-B", callback=after_iteration,
        options={"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": MEMORY, "ftol": 0},
    )  # fmt: skip
    return with_maps(found.x)


def iterations_over(shots: Sequence[Shot]) -> int:
    """Most iterations of a fit to some shots."""
    return min(ITERATIONS, max(FEWEST, WORK // sum(shot.counts.size for shot in shots)))


def spacings(shape: tuple[int, int], turns: int) -> list[float]:
    """Spacings of nodes (panel pixels) from coarse to fine, for a panel of that shape: each half the one before."""
    coarsest = COARSEST * min(shape)
    return [max(FINEST, coarsest / 2**turn) for turn in range(turns)]
