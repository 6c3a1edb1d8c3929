"""Values that effects read off the captures instead of fitting them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import j0

from trainer.device import array_of
from trainer.effects.evidence import Evidence
from trainer.effects.starts import displacements

LIKELY_GAIN, LIKELY_OFFSET = 0.05, 20.0  # where the estimate of their spreads begins: share, counts
LIKELY_VARIANCES = tuple(0.06 * 1.6**n for n in range(-1, 10))  # of a blur, pixels^2, from 0.04 to 4
ROUNDS = 6  # of taking away what neighbours tell
SPREAD_ROUNDS, SETTLED = (
    300,
    1e-3,
)  # of the spreads' estimate at most, and the share of them that a last one changes
SPREAD_PIXELS = 50_000  # that it is made from
REACH = 3  # pixels each way: the neighbours that a pixel's number is predicted from
WEIGHT_PIXELS = 500_000  # at most, that the neighbours' weights are found from
BLUR_PIXELS = 512  # an axis, of the middle of a picture: there, a blur is what it is everywhere


def shift_spread(evidence: Sequence[Evidence]) -> dict[str, Any]:
    """Standard deviation (pixels) of the displacement from capture to capture, along an axis."""
    shifts: dict[tuple[str, float], list[np.ndarray]] = {}
    for one in evidence:
        for k in range(len(one.batch.ids)):
            _, moved, weights = displacements(one.of(k))
            middle = np.average(moved, axis=0, weights=weights + 1e-12)
            shifts.setdefault((one.scene.channel, one.scene.plane_mm), []).append(middle)
    deviations = np.concatenate([np.array(s) - np.mean(s, axis=0) for s in shifts.values()])
    return {"spread": max(0.01, float(np.sqrt(np.mean(deviations**2))))}


def blur_rms(evidence: Sequence[Evidence]) -> dict[str, Any]:
    """Rms (camera pixels) of the blur along the direction in which captures are blurred most, over all of them."""
    variances = []
    for one in evidence:
        for k in range(len(one.batch.ids)):
            sharp = array_of(one.prediction[k].double())
            blurred, weight = (array_of(t[k].double()) for t in (one.batch.signal, one.batch.mask))
            variances.append(_blur_variance(*map(_middle, (sharp, blurred, weight))))
    return {"rms": max(0.05, float(np.sqrt(np.mean(variances))))}


def _middle(picture: np.ndarray) -> np.ndarray:
    first = [max(0, n - BLUR_PIXELS) // 2 for n in picture.shape]
    return picture[first[0] : first[0] + BLUR_PIXELS, first[1] : first[1] + BLUR_PIXELS]


def _blur_variance(sharp: np.ndarray, blurred: np.ndarray, weight: np.ndarray) -> float:
    """Variance (pixels^2) of a swing along its direction: the one of some tried that fits best."""
    fy, fx = np.fft.fftfreq(sharp.shape[0])[:, None], np.fft.fftfreq(sharp.shape[1])[None, :]
    spectrum = np.fft.fft2(sharp)
    best = (-np.inf, 0.0)
    for angle in np.deg2rad(np.arange(0, 180, 15)):
        along = (2 * np.pi * (fx * np.cos(angle) + fy * np.sin(angle))) ** 2
        for variance in LIKELY_VARIANCES:
            trial = np.fft.ifft2(spectrum * j0(np.sqrt(2 * variance * along))).real
            power = float((weight * trial**2).sum())
            best = max(best, (float((weight * trial * blurred).sum()) ** 2 / max(power, 1e-30), variance))
    return best[1]


def pixel_pattern(evidence: Sequence[Evidence]) -> dict[str, Any]:
    """Gain and offset of each camera pixel beyond what its neighbours tell, as all captures together show them.

    The most probable values where both are drawn from normal distributions, whose spreads are estimated from the
    captures, too. What can be told from a pixel's neighbours, such as shading and fringes, is left to other effects.
    """
    sums = np.zeros((5, *evidence[0].batch.signal.shape[-2:]))
    for one in evidence:
        weight = array_of((one.batch.mask / one.batch.noise).double())
        beyond = array_of((one.batch.signal - one.prediction).double())
        # What a count more, and so many times the light, do to the counts.
        straight = one.prediction if one.straight is None else one.straight
        more = np.ones_like(beyond) if one.slope is None else array_of(one.slope.double())
        louder = more * array_of(straight.double())
        terms = (louder**2, louder * more, more**2, louder * beyond, more * beyond)
        sums += np.stack([(weight * t).sum(0) for t in terms])
    # First what neighbours tell goes, again and again, because each time it is drawn towards zero.
    for _ in range(ROUNDS):
        gain, offset, _ = _most_probable(sums, LIKELY_GAIN, LIKELY_OFFSET)
        gain, offset = gain - _own(gain), offset - _own(offset)
        sums[3] -= sums[0] * gain + sums[1] * offset
        sums[4] -= sums[1] * gain + sums[2] * offset
    gain_spread, offset_spread = _spreads(sums)
    gain, offset, _ = _most_probable(sums, gain_spread, offset_spread)
    return {
        "gain": np.maximum(gain, -0.99),
        "offset": offset,
        "gain_rms": max(100 * gain_spread, 0.01),
        "offset_rms": max(offset_spread, 0.01),
    }


def _spreads(sums: np.ndarray) -> tuple[float, float]:
    """Spreads of the pixels' gains and offsets that make what was seen most probable (expectation maximisation).

    References
    ----------
    Dempster, Laird and Rubin 1977, Maximum likelihood from incomplete data via the EM algorithm, J. R. Stat. Soc. B
    39, 1.
    """
    some = sums.reshape(len(sums), -1)
    some = some[:, :: max(1, some.shape[1] // SPREAD_PIXELS)]
    spreads = LIKELY_GAIN, LIKELY_OFFSET
    for _ in range(SPREAD_ROUNDS):
        gain, offset, variances = _most_probable(some, *spreads)
        found = [float(np.sqrt(np.mean(v**2 + s))) for v, s in zip((gain, offset), variances, strict=True)]
        before, spreads = spreads, (max(found[0], 1e-5), max(found[1], 1e-3))
        if all(abs(a / b - 1) < SETTLED for a, b in zip(spreads, before, strict=True)):
            break
    return spreads


def _most_probable(
    sums: np.ndarray, gain_spread: float, offset_spread: float
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Gain and offset of each pixel and their variances, for spreads of both."""
    a, b, c = sums[0] + gain_spread**-2, sums[1], sums[2] + offset_spread**-2
    determinant = a * c - b**2
    gain = (c * sums[3] - b * sums[4]) / determinant
    offset = (a * sums[4] - b * sums[3]) / determinant
    return gain, offset, (c / determinant, a / determinant)


def _own(numbers: np.ndarray) -> np.ndarray:
    """Each pixel's number less the best prediction from its neighbours: linear, with the same weights everywhere.

    Neighbours on opposite sides tell as much of it, and have one weight.
    """
    height, width = numbers.shape
    padded = np.pad(numbers, REACH, mode="reflect", reflect_type="odd")
    span = 2 * REACH + 1
    places = [(n // span, n % span) for n in range(span**2 // 2)]

    def pairs(i: int, j: int, apart: int = 1) -> np.ndarray:
        near = padded[i : i + height : apart, j : j + width : apart]
        i, j = 2 * REACH - i, 2 * REACH - j
        return near + padded[i : i + height : apart, j : j + width : apart]

    apart = math.ceil(math.sqrt(numbers.size / WEIGHT_PIXELS))
    near = np.stack([pairs(i, j, apart).ravel() for i, j in places])
    normal = near @ near.T
    normal += (1e-9 * np.trace(normal) / len(normal) + 1e-30) * np.eye(len(normal))
    weights = np.linalg.solve(normal, near @ numbers[::apart, ::apart].ravel())
    own = numbers.copy()
    for (i, j), share in zip(places, weights, strict=True):
        own -= share * pairs(i, j)
    return own
