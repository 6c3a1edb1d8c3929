"""The panel's phase response from a sweep of binary gratings: gray 0 on one half of the lines, gray g on the other.

The field is then a sum of two, one of them turned by the phase d between the two grays, so every camera pixel sees
A + B cos d + C sin d. A, B and C follow from the light path at three trial phases; d and its error follow by linear
least squares over all pixels, and which of several turns it is from its neighbours in the sweep.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, predicted, shot_of
from runtime.calibration.prediction import Predictor
from runtime.calibration.shown_patterns import grating
from runtime.camera.view import Sampler
from runtime.lightpath.legendre import legendre_curve
from runtime.lightpath.light_path import LightPath

SWEEP = (*range(16, 256, 16), 255)  # gray levels
PERIODS = (4, 6, 8, 12, 16, 24)  # pixels
TERMS = 6  # of the curve's deviation from what was believed
SAMPLE = 400_000  # pixels of a picture that a phase is fitted to: then its error is far below a milliradian
TRIALS = (0.0, 2 * math.pi / 3, -2 * math.pi / 3)


@dataclass(frozen=True)
class Sweep:
    """A measured sweep of gray levels.

    Attributes
    ----------
    gray : int array [n]
    phase : float array [n], rad
        From gray 0.
    error : float array [n], rad
        Standard errors of the phase.
    visibility : float array [n]
        Contrast of the gratings against the prediction; 1 where the light path is right.
    """

    gray: np.ndarray
    phase: np.ndarray
    error: np.ndarray
    visibility: np.ndarray


def swept(path: LightPath) -> tuple[int, ...]:
    """The gray levels to sweep: SWEEP, and of a panel with few gray levels some that it has."""
    has = np.array(path.gray_levels[1:])
    if len(has) > len(SWEEP):
        has = np.unique([has[np.abs(has - gray).argmin()] for gray in SWEEP])
    return tuple(has.tolist()) or SWEEP


def best_period(base: ColourLightPath, channel: str, estimate: Estimate, sample: Sampler) -> int:
    """The period of a grating whose phase changes the picture most in this plane, panel pixels.

    Gratings image themselves at some distances (the Talbot effect), and there a phase changes nothing.
    """
    believed = np.asarray(estimate.drift.response.get(channel, base.path.response), float)

    def contrast(period: int) -> float:
        shot = _blank(channel, base, period, 128)

        def predict(response: np.ndarray) -> np.ndarray:
            drift = replace(estimate.drift, response={channel: response})
            return predicted(base, shot, replace(estimate, drift=drift), sample)

        _, cosine, sine = _harmonics(predict, believed, 128)
        return float(np.mean(cosine**2 + sine**2))

    return max(PERIODS, key=contrast)


def _blank(channel: str, base: ColourLightPath, period: int, gray: int) -> Shot:
    """A grating without a picture."""
    nothing = np.zeros((1, 1), np.float32)
    return shot_of(channel, grating(base.path.grid.shape, period, gray), nothing, 0.0, nothing)


def measured_sweep(predictor: Predictor, shots: Sequence[Shot]) -> Sweep:
    """The phase of each grating's brighter gray level from gray 0.

    Parameters
    ----------
    predictor : Predictor
        Of an estimate. All but the response is taken from it; its response says where the search starts.
    shots : sequence of Shot
        Of gratings of one colour, of each as many rows as `rows_apart` says.
    """
    channel = shots[0].channel
    assert predictor.view is not None
    every = rows_apart(predictor.view.shape)
    path = predictor.paths[channel]
    believed = np.asarray(path.response, float)
    # Where the phase is all that a gray level changes, three pictures of one grating are those of all.
    alike = path.crosstalk is None and path.modulation is None and path.gain is None
    alike = alike and all(np.array_equal(s.gray > 0, shots[0].gray > 0) for s in shots)
    found, parts = [], None
    for shot in shots:
        gray = int(shot.gray.max())
        start = float(believed[gray] - believed[0])
        if parts is None or not alike:
            parts = _parts_of(predictor, shot, believed, 0.0 if alike else start)
        model = np.stack([m[::every].ravel() for m in parts], 1)
        root = np.sqrt(shot.weight.ravel())
        weighted = (model * root[:, None]).astype(np.float64)
        normal = weighted.T @ weighted
        gain, cosine, sine = np.linalg.solve(normal, weighted.T @ (root * shot.signal.ravel()))
        size2 = max(float(cosine**2 + sine**2), 1e-30)
        across = np.array([0.0, -sine, cosine]) / size2
        error = math.sqrt(float(across @ np.linalg.solve(normal, across)))
        beyond = math.atan2(sine, cosine)
        phase = beyond + 2 * math.pi * round((start - beyond) / (2 * math.pi)) if alike else start + beyond
        found.append((gray, phase, error, math.sqrt(size2) / max(gain, 1e-30)))
    grays, phases, errors, visibility = (np.array(v) for v in zip(*sorted(found), strict=True))
    # one turn more or less than was believed is told by the neighbours: the sweep's steps are far below a turn
    unwrapped = np.unwrap(np.concatenate([[0.0], phases]))[1:]
    return Sweep(grays, unwrapped, errors, visibility)


def rows_apart(camera: tuple[int, int]) -> int:
    """Of how many rows of a grating's picture (h, w) one is used: along its lines it is the same."""
    return math.ceil(camera[0] * camera[1] / SAMPLE)


def thinned(shot: Shot) -> Shot:
    """A capture of a grating with the rows that are used: sixteen whole ones would be half of all captures."""
    every = rows_apart(shot.counts.shape)
    return shot.rows(slice(None, None, every))


def _parts_of(predictor: Predictor, shot: Shot, believed: np.ndarray, start: float) -> tuple[np.ndarray, ...]:
    """`_harmonics` of a grating about a phase `start` (rad) from gray 0 to its own gray level."""
    gray = int(shot.gray.max())
    response = believed.copy()
    response[gray] = believed[0] + start
    return _harmonics(lambda r: predictor.light(shot, r), response, gray)


def _harmonics(
    predict: Callable[[np.ndarray], np.ndarray], believed: np.ndarray, gray: int
) -> tuple[np.ndarray, ...]:
    """A, B and C [h, w] of what the camera sees of a grating, for a phase d of its gray beyond what is believed.

    `predict` gives what the camera sees with a response.
    """
    trials = []
    for trial in TRIALS:
        response = believed.copy()
        response[gray] += trial
        trials.append(predict(response))
    mean = (trials[0] + trials[1] + trials[2]) / 3
    return mean, (2 * trials[0] - trials[1] - trials[2]) / 3, (trials[1] - trials[2]) / math.sqrt(3)


def fitted_response(believed: np.ndarray, sweep: Sweep, gray_levels: Sequence[int] = ()) -> np.ndarray:
    """A response that follows a sweep: the one that was believed, and a smooth deviation, 0 at gray 0.

    Parameters
    ----------
    believed : float array [levels], rad
    sweep : Sweep
    gray_levels : sequence of int
        As in a LightPath: others go on having the phase of the one that they are shown as.

    Returns
    -------
    float array [levels], rad
        Monotone if `believed` is.
    """
    levels = len(believed)
    t = np.arange(levels) / (levels - 1)
    shapes = t * legendre_curve(2 * t - 1, min(TERMS, len(sweep.gray)))
    deviation = sweep.phase - (believed[sweep.gray] - believed[0])
    weight = 1 / np.hypot(sweep.error, 1e-3)  # no panel is smoother than a milliradian
    terms = np.linalg.lstsq((shapes[:, sweep.gray] * weight).T, deviation * weight, rcond=None)[0]
    response = believed + terms @ shapes
    if gray_levels:
        has = np.array(gray_levels)
        response = response[has[np.abs(believed[:, None] - believed[has]).argmin(1)]]
    steps = np.diff(believed)
    if (steps >= 0).all():
        return np.maximum.accumulate(response)
    return np.minimum.accumulate(response) if (steps <= 0).all() else response
