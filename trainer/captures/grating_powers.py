"""A panel's phase response from the power of gratings: gray 0 on one half of the lines, gray g on the other.

The first order's power is o + e(g) (1 - cos phase(g)) / 2: the offset o is light that the grating does not steer, and
the envelope e falls where a real panel's contrast does. Phase and envelope are smooth curves, fitted together. The
errors come from what the fit leaves, and allow for neighbours that err alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares, nnls
from scipy.signal import find_peaks

from firmware_iface.errors import InputError

PROMINENCE = 0.25  # of the range of power: what turns less than this is noise
KNOTS_A_HALF_WAVE = 2  # of the phase curve
FEWEST_KNOTS = 4
MOST_ENVELOPE_TERMS = 3  # each needs two half waves, or it could not be told from phase
FEWEST = 16  # gray levels


@dataclass(frozen=True)
class GratingResponse:
    """A phase response that was fitted to the powers of a grating sweep.

    Attributes
    ----------
    gray : int array [n]
    power : float array [n], any unit
    fitted : float array [n]
        The power that the response gives.
    phase : float array [n], rad
        From the first gray level; its sign cannot be seen in power.
    error : float array [n], rad
        Standard error of the phase.
    """

    gray: np.ndarray
    power: np.ndarray
    fitted: np.ndarray
    phase: np.ndarray
    error: np.ndarray

    @property
    def left(self) -> float:
        """Root mean square of the power that is not explained, over the range of power."""
        return float(np.std(self.power - self.fitted) / np.ptp(self.power))

    def gray_of(self, phase: np.ndarray) -> np.ndarray:
        """The gray levels, not rounded, that give these phases."""
        return np.interp(phase, np.maximum.accumulate(self.phase), self.gray)


def read_powers(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Gray levels and powers from a table of two columns, comma-separated; a header is skipped.

    Raises
    ------
    InputError
        Where it is no such table, or too short.
    """
    try:
        lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read ({error}): give a table of gray levels and powers") from None
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(lines, 1):
        try:
            gray, power = (float(cell) for cell in line.split(","))
        except ValueError:
            if number == 1:
                continue
            raise InputError(f"{path} line {number} is not 'gray,power': {line[:60]!r}; correct it") from None
        if not (math.isfinite(gray) and math.isfinite(power)):
            raise InputError(
                f"{path} line {number} has no finite number: measure it again, or remove the line"
            )
        rows.append((gray, power))
    table = np.array(sorted(rows)).reshape(-1, 2)
    if len(table) < FEWEST or (np.diff(table[:, 0]) <= 0).any():
        raise InputError(
            f"{path} needs at least {FEWEST} different gray levels, each once: sweep the panel's range"
        )
    return table[:, 0], table[:, 1]


def phase_of_power(power: np.ndarray) -> np.ndarray:
    """Phase of each gray level from the first-order power of gratings of gray 0 and that gray.

    Power goes as (1 - cos phase) / 2 between its extremes, which may differ from turn to turn, as on a real panel.
    Phase starts at 0 and only grows; beyond the last extreme the last range of power holds.

    Parameters
    ----------
    power : float array [levels]

    Returns
    -------
    float array [levels], rad

    Raises
    ------
    InputError
        Where power never turns, so that there is no half wave to measure by.
    """
    power = np.asarray(power, float)
    smooth = gaussian_filter1d(power, 1.0)
    turns = _turns(smooth)
    if len(turns) == 0:
        raise InputError(
            "the first order's power has no maximum over the gray levels, so the panel's phase stays below half a "
            "wave: give it more voltage range, or sweep at a shorter wavelength"
        )
    edges = [0, *turns.tolist(), len(power) - 1]
    phase = np.zeros(len(power))
    low, high = smooth[0], smooth[turns[0]]
    for half, (first, last) in enumerate(pairwise(edges)):
        if half < len(turns):
            low, high = smooth[first], smooth[last]
        else:  # an unfinished half wave: it would reach what the one before came from
            low, high = smooth[first], smooth[edges[half - 1]]
        inside = slice(first, last + 1)
        share = np.clip((power[inside] - low) / (high - low), 0, 1)
        phase[inside] = math.pi * half + np.arccos(1 - 2 * share)
    return np.maximum.accumulate(phase)


def _turns(smooth: np.ndarray) -> np.ndarray:
    least = PROMINENCE * float(np.ptp(smooth))
    return np.sort(np.concatenate([find_peaks(s * smooth, prominence=least)[0] for s in (1, -1)]))


def fitted_to_powers(gray: np.ndarray, power: np.ndarray) -> GratingResponse:
    """The phase response that explains the powers of a sweep, with its error.

    Parameters
    ----------
    gray : float array [n], ascending
    power : float array [n], any unit

    Returns
    -------
    GratingResponse

    Raises
    ------
    InputError
        As `phase_of_power` does.
    """
    start = phase_of_power(power)
    t = (gray - gray[0]) / (gray[-1] - gray[0])
    # knots where the phase needs them: equally far apart in half waves as in gray levels
    spread = 0.5 * t + 0.5 * start / start[-1]
    spans = max(FEWEST_KNOTS, round(KNOTS_A_HALF_WAVE * start[-1] / math.pi))
    inner = np.interp(np.arange(1, spans) / spans, spread, t)
    shapes = BSpline.design_matrix(t, np.concatenate([[0.0] * 4, inner, [1.0] * 4]), 3).toarray()
    shapes = np.cumsum(shapes[:, ::-1], axis=1)[:, ::-1][:, 1:]  # steps >= 0: phase grows
    turns = len(_turns(gaussian_filter1d(power, 1.0)))
    terms = np.polynomial.legendre.legvander(2 * t - 1, min(MOST_ENVELOPE_TERMS, (turns + 1) // 2) - 1)
    unit = float(np.ptp(power))
    count = shapes.shape[1]

    def model(values: np.ndarray) -> np.ndarray:
        phase, envelope = shapes @ values[:count], terms @ values[count:-1]
        return np.asarray(values[-1] + envelope * (1 - np.cos(phase)) / 2)

    steps = nnls(shapes, start)[0] + 1e-3
    first = np.concatenate([steps, [1.0], np.zeros(terms.shape[1] - 1), [power.min() / unit]])
    least = np.where(np.arange(len(first)) < count, 0.0, -np.inf)
    found = least_squares(
        lambda values: model(values) - power / unit, first, bounds=(least, np.inf), x_scale=0.1
    )
    left = found.fun - found.fun.mean()
    free = max(len(left) - len(found.x), 1)
    alike = [float(left[k:] @ left[:-k]) / float(left @ left) for k in range(1, len(left) // 4)]
    runs = next((k for k, r in enumerate(alike) if r <= 0), len(alike))
    factor = 1 + 2 * sum(alike[:runs])  # neighbours that err alike count as fewer
    covariance = float(left @ left) / free * factor * np.linalg.pinv(found.jac.T @ found.jac)
    error = np.sqrt(np.einsum("nk,kl,nl->n", shapes, covariance[:count, :count], shapes))
    return GratingResponse(gray, power, model(found.x) * unit, shapes @ found.x[:count], error)
