"""The camera's noise model, and what repeated pictures of one pattern tell about the camera.

Light makes noise whose variance grows in proportion to the counts above black. So the line of variance against mean
count points to the true black level. Stray light does not change this, because it brings its own noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trainer.captures.bench_file import Camera

BINS = 32
SLOPE_DOUBT = 0.008  # relative standard error that a stated full well has at best
SURE = 4.0  # standard errors from which a slope or a bend counts
CORRELATED = 0.05  # correlation of neighbouring pixels from which a difference is no noise
MOVED = 0.01  # share of a difference that looks like a motion, from which it is no noise
BY_CHANCE = 25.0  # over the pixels: share of noise that looks so in one of seven thousand pairs
BEND = 0.25  # of the variance at the brightest bin that a bend may add before it is no line


@dataclass(frozen=True)
class RepeatNoise:
    """Variance against mean of pictures of one pattern, in bins of about equal numbers of pixels.

    Attributes
    ----------
    mean : float array [n], raw counts
    variance : float array [n], counts^2
    error : float array [n], counts^2
        Standard error of the variance.
    ratio, ratio_error : float
        Measured noise over the camera model's, both averaged over the pixels, and its standard error.
    black_level : float, counts
        The stated one.
    correlation : float
        Of the difference of the two pictures from pixel to pixel, along rows and columns. A camera's noise has none.
    moved : float
        Share of the difference that a displacement or another blur of the picture explains, beyond what chance may.
    """

    mean: np.ndarray
    variance: np.ndarray
    error: np.ndarray
    ratio: float
    ratio_error: float
    black_level: float
    correlation: float = 0.0
    moved: float = 0.0

    @property
    def is_noise(self) -> bool:
        """Whether the pictures differ by the camera's noise alone, as far as their own structure tells."""
        return abs(self.correlation) < CORRELATED and self.moved < MOVED

    def ratio_to(self, camera: Camera) -> float:
        """Measured noise over that of a camera with other numbers than the stated."""
        if not self.mean.size:  # too few pixels for a bin
            return self.ratio
        return float(self.variance.mean() / noise_variance(self.mean - self.black_level, camera).mean())


@dataclass(frozen=True)
class NoiseLine:
    """The straight line of variance against mean count.

    Attributes
    ----------
    slope, slope_error : float, counts
        Counts that one electron adds, and its standard error.
    at_black : float, counts^2
        Variance at the stated black level.
    """

    slope: float
    slope_error: float
    at_black: float


@dataclass(frozen=True)
class BlackEstimate:
    """The black level that the noise points to.

    Attributes
    ----------
    level : float, raw counts
    error : float, raw counts
        Standard error of the level.
    """

    level: float
    error: float


def noise_variance(signal: Any, camera: Camera) -> Any:
    """Variance that the camera's noise gives a signal: shot noise, read noise and the rounding to whole counts.

    Parameters
    ----------
    signal : float or float array, counts above black
    camera : Camera

    Returns
    -------
    float or float array, counts^2
        Of the signal's shape.
    """
    gain = camera.counts_per_electron
    return np.maximum(signal, 0) * gain + ((camera.read_noise_e * gain) ** 2 + 1 / 12)


def compare_repeats(first: np.ndarray, second: np.ndarray, camera: Camera) -> RepeatNoise | None:
    """The noise of two pictures of one pattern.

    A difference in brightness between the two (the laser's drift) is removed first.

    Parameters
    ----------
    first, second : uint16 array [h, w], raw counts
    camera : Camera

    Returns
    -------
    RepeatNoise or None
        None where too few pixels are unsaturated.
    """
    use = (first < camera.saturation) & (second < camera.saturation)
    if int(use.sum()) < 256:
        return None
    a, b = first[use].astype(np.float64), second[use].astype(np.float64)
    spread = float(a.std()) / max(float(b.std()), 1e-9)
    gain = spread if 0.5 < spread < 2 and np.corrcoef(a, b)[0, 1] > 0.5 else 1.0
    mean = (a + b) / 2
    difference = a - a.mean() - gain * (b - b.mean())
    halved = difference**2 / (1 + gain**2)
    edges = np.unique(np.quantile(mean, np.linspace(0, 1, BINS + 1)))
    place = np.clip(np.searchsorted(edges, mean, side="right") - 1, 0, max(len(edges) - 2, 0))
    number = np.bincount(place, minlength=max(len(edges) - 1, 1))
    full = number >= 32
    center = np.bincount(place, mean, minlength=len(number))[full] / number[full]
    variance = np.bincount(place, halved, minlength=len(number))[full] / number[full]
    expected = float(noise_variance(mean - camera.black_level, camera).mean())
    spread = float(halved.std()) / math.sqrt(halved.size)
    return RepeatNoise(
        center,
        variance,
        variance * np.sqrt(2 / number[full]),
        float(halved.mean()) / expected,
        spread / expected,
        camera.black_level,
        _neighbours_correlation(use, difference),
        _share_moved(use, (first.astype(np.float64) + second) / 2, difference) - BY_CHANCE / halved.size,
    )


def _neighbours_correlation(use: np.ndarray, values: np.ndarray) -> float:
    """The larger correlation, along rows or columns, of a picture's neighbouring values, given where `use` is set."""
    picture = np.zeros(use.shape)
    picture[use] = values
    power = float((picture**2).sum()) / max(int(use.sum()), 1)
    found = []
    for one, next_one in ((np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:])):
        both = max(int((use[one] & use[next_one]).sum()), 1)
        found.append(float((picture[one] * picture[next_one]).sum()) / both / max(power, 1e-30))
    return max(found, key=abs)


def _share_moved(use: np.ndarray, mean: np.ndarray, difference: np.ndarray) -> float:
    """Share of a difference, given where `use` is set, that lies in the span of the mean picture's derivatives.

    To first order a displacement adds first derivatives of a picture, and a little more blur second ones.
    """
    down, across = np.gradient(mean)
    bends = (
        np.diff(np.pad(mean, ((1, 1), (0, 0)), "edge"), 2, 0),
        np.diff(np.pad(mean, ((0, 0), (1, 1)), "edge"), 2, 1),
    )
    terms = np.stack([one[use] for one in (down, across, np.gradient(down, axis=1), *bends)])
    normal, along = terms @ terms.T, terms @ difference
    explained = along @ np.linalg.pinv(normal, hermitian=True) @ along
    return float(explained / max(float(difference @ difference), 1e-30))


def straight_line(repeats: Sequence[RepeatNoise], camera: Camera) -> NoiseLine | None:
    """Variance against mean as a straight line.

    Returns
    -------
    NoiseLine or None
        None where the range of brightness is too small, where no line rises, or where the variance bends away from
        it by more than BEND of itself: then more than the camera's noise differs between the pictures.
    """
    mean = np.concatenate([r.mean for r in repeats]) if repeats else np.zeros(0)
    variance = np.concatenate([r.variance for r in repeats]) if repeats else np.zeros(0)
    if len(mean) < 8 or np.ptp(mean) < 0.02 * camera.full_scale or not (variance > 0).all():
        return None
    relative = np.concatenate([r.error for r in repeats]) / variance + 1e-3
    step = float(np.ptp(mean))
    place = (mean - camera.black_level) / step
    line = _fit(np.stack([np.ones_like(place), place], 1), variance, relative)
    bent = _fit(np.stack([np.ones_like(place), place, place**2], 1), variance, relative)
    if line is None or bent is None:
        return None
    (at_black, rise), covariance = line
    bend, bend_error = bent[0][2], math.sqrt(bent[1][2, 2])
    if rise <= SURE * math.sqrt(covariance[1, 1]):
        return None
    if abs(bend) > SURE * bend_error and abs(bend) > BEND * rise:
        return None
    return NoiseLine(float(rise) / step, math.sqrt(covariance[1, 1]) / step, float(at_black))


def black_estimate(repeats: list[RepeatNoise], camera: Camera) -> BlackEstimate | None:
    """The black level at which the line of variance against mean reaches the stated read noise.

    Returns
    -------
    BlackEstimate or None
        None where the range of brightness is too small to draw a line, or where no line rises.
    """
    mean = np.concatenate([r.mean for r in repeats]) if repeats else np.zeros(0)
    variance = np.concatenate([r.variance for r in repeats]) if repeats else np.zeros(0)
    if len(mean) < 8 or np.ptp(mean) < 0.02 * camera.full_scale or not (variance > 0).all():
        return None
    relative = np.concatenate([r.error for r in repeats]) / variance + 1e-3
    low, step = float(mean.min()), float(np.ptp(mean))
    place = (mean - low) / step
    floor = float(noise_variance(0.0, camera))
    line = _fit(np.stack([np.ones_like(place), place], 1), variance, relative)
    bent = _fit(np.stack([np.ones_like(place), place, place**2], 1), variance, relative)
    if line is None or bent is None:
        return None
    fit, covariance = bent if abs(bent[0][2]) > 4 * math.sqrt(bent[1][2, 2]) else line
    if fit[1] <= 3 * math.sqrt(covariance[1, 1]):
        return None
    reach = (fit[0] - floor) / fit[1]  # how far below the darkest bin, in units of the range
    gradient = np.array([-1 / fit[1], reach / fit[1], 0])[: len(fit)]
    free = BlackEstimate(low - step * float(reach), step * math.sqrt(float(gradient @ covariance @ gradient)))
    slope, spread = float(fit[1]) / step, math.sqrt(covariance[1, 1]) / step
    if abs(slope - camera.counts_per_electron) > 3 * spread:
        return free
    # the stated full well fits the slope: a line of that slope reaches down to black with less error
    weight = 1 / (relative * np.maximum(line[0][0] + line[0][1] * place, 1e-2 * float(variance.mean()))) ** 2
    above = (variance - floor) / camera.counts_per_electron
    level = float(np.average(mean - above, weights=weight))
    error = math.hypot(
        1 / (math.sqrt(float(weight.sum())) * camera.counts_per_electron),
        SLOPE_DOUBT * float(np.average(above, weights=weight)),
    )
    return BlackEstimate(level, error) if error < free.error else free


def _fit(
    terms: np.ndarray, variance: np.ndarray, relative: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Weighted least squares and its covariance; None where the terms do not determine it.

    The weights follow the fit, not each bin's own variance: a bin that came out low must not count for more.
    """
    level = variance
    try:
        for _ in range(3):
            scaled = terms / (level * relative)[:, None]
            fit, *_ = np.linalg.lstsq(scaled, variance / (level * relative), rcond=None)
            level = np.maximum(terms @ fit, 1e-2 * float(variance.mean()))
        return fit, np.linalg.inv(scaled.T @ scaled)
    except np.linalg.LinAlgError:
        return None
