"""Free-form maps over the panel: what is left of wavefront and beam after the polynomials.

A real panel and its beam have structure as fine as a few pixels. Maps of cubic B-splines with a node every few
pixels are fitted to the same captures by L-BFGS (Liu and Nocedal 1989), with the light path's own adjoint. A capture
gives one measurement a pixel, and a map has one number every NODE x NODE pixels, so ten patterns determine it
some 160 times over. A weak prior holds what no light shows, and few iterations keep the rest from following noise.
Time and memory grow only with the number of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from runtime.calibration.estimate import ColourLightPath, Estimate, Shot
from runtime.calibration.misfit import Misfit
from runtime.lightpath.spline_maps import node_weights, nodes_over
from runtime.program.progress import Progress

NODE = 4  # panel pixels
MOST = (270, 480)  # nodes: larger panels get coarser maps
LIKELY_NM, LIKELY_LOG = 30.0, 0.3  # standard deviations of a node, before any capture
ITERATIONS = 30
MEMORY = 8  # steps that L-BFGS remembers


def fit_freeform(
    bases: Mapping[str, ColourLightPath],
    shots: Sequence[Shot],
    start: Estimate,
    progress: Progress | None = None,
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

    Returns
    -------
    Estimate
        Its drift has one map of the wavefront for all colours, and one of the beam for each colour.
    """
    shape = next(iter(bases.values())).path.grid.shape
    rows, columns = (node_weights(n, m).astype(np.float32) for n, m in zip(shape, nodes_of(shape), strict=True))
    nodes = (rows.shape[1], columns.shape[1])
    channels = tuple(bases)
    misfit = Misfit(bases, shots, motion=False)
    done = 0

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

    def count_iteration(_: np.ndarray) -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done / ITERATIONS)

    drift, nothing = start.drift, np.zeros(nodes)
    begin = [drift.wavefront_nodes_nm / LIKELY_NM if drift.wavefront_nodes_nm.size else nothing]
    begin += [drift.amplitude_nodes.get(c, nothing) / LIKELY_LOG for c in channels]
    found = minimize(
        cost, np.ravel(begin), jac=True, method="L-BFGS-B", callback=count_iteration,
        options={"maxiter": ITERATIONS, "maxfun": 2 * ITERATIONS, "maxcor": MEMORY, "ftol": 1e-7},
    )  # fmt: skip
    return with_maps(found.x)


def nodes_of(shape: tuple[int, int]) -> tuple[int, int]:
    """Nodes of a map over a panel of that shape, (rows, columns)."""
    rows, columns = (min(n, most) for n, most in zip(nodes_over(shape, NODE), MOST, strict=True))
    return rows, columns
