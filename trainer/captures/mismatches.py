"""Images beside the wrong patterns: a column shifted by a row, two images swapped, one image for all captures.

Each image is correlated with the ideal prediction of its own pattern, as in `trainer.captures.conventions`. Where that
is low beside the best of the set, it is correlated with the predictions of the other patterns, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from scipy import fft as spfft

from trainer.captures.bench_file import Bench
from trainer.captures.conventions import (
    R_RATIO,
    T_LEVEL,
    Predict,
    Sample,
    beyond_chance,
    central_part,
    flattened,
    paired_t,
    tile_correlations,
)
from trainer.captures.distance_search import best_distance
from trainer.captures.problems import Problem

SUSPECT = 0.5  # of the set's best correlation: below it, an image is compared with other patterns
SEARCHED = 2  # images that other distances are tried on
PEAK = 8.0  # standard deviations of a cross-correlation that its peak must reach
MOST_SUSPECTS = 12  # images that are compared with all patterns


def mismatched(bench: Bench, samples: Iterable[Sample], predict: Predict) -> list[Problem]:
    """Captures whose image fits another capture's pattern decisively better than their own.

    Where no image fits any pattern, the images are moved farther, and other distances are searched.

    Parameters
    ----------
    bench : Bench
    samples : iterable of Sample
        Captures of one colour and plane, with different patterns; one is in memory at a time.
    predict : callable
        The ideal model: (bench, gray, channel, plane_mm) -> irradiance [h, w] on any scale.

    Returns
    -------
    list of Problem
        Of kind "mismatched"; where no image fits any pattern one of kind "shifted" or "distance", if that helps, or
        "no_correlation".
    """
    names, predictions, images = [], [], []
    first: list[Sample] = []
    for sample in samples:
        near, gray, image, valid, core = central_part(bench, sample)
        made = np.asarray(predict(near, gray, sample.channel, sample.plane_mm), dtype=np.float32)[core]
        prediction = flattened(made, np.ones(made.shape, bool))
        if not prediction.any():  # a pattern without structure fits nothing in particular
            continue
        names.append(sample.capture)
        first = [*first, sample][:SEARCHED]
        predictions.append(prediction)
        images.append((flattened(image, valid), valid))
    count = len(names)
    own = [tile_correlations(*images[k], predictions[k])[0] for k in range(count)]
    means = [float(np.mean(values)) for values in own]
    best = max(means, default=0.0)
    least = beyond_chance(predictions[0].size if predictions else math.inf)
    suspects = [k for k in range(count) if means[k] < max(SUSPECT * best, least)][:MOST_SUSPECTS]
    found, fits_some = [], best >= least
    for k in suspects:
        others = [j for j in range(count) if j != k]
        values = {j: tile_correlations(*images[k], predictions[j])[0] for j in others}
        nearest = max(others, key=lambda j: float(np.mean(values[j])), default=None)
        if nearest is None:
            continue
        there = float(np.mean(values[nearest]))
        decisive = there >= least and there >= R_RATIO * max(means[k], 0.0)
        if decisive and paired_t(values[nearest], own[k]) > T_LEVEL:
            fits_some = True
            found.append(_problem(names[k], names[nearest], means[k], there))
    if not fits_some and count > 1:
        found.append(
            _shifted(names[0], images[0][0], predictions[0])
            or _elsewhere(bench, first, predict, best, least)
            or _nothing_fits(names, best)
        )
    return found


def _shifted(capture: str, image: np.ndarray, prediction: np.ndarray) -> Problem | None:
    """Whether an image fits its pattern when it is moved by more than WINDOW."""
    cross = spfft.irfft2(spfft.rfft2(image) * np.conj(spfft.rfft2(prediction)), s=image.shape)
    at = np.unravel_index(int(np.argmax(cross)), cross.shape)
    if float(cross[at]) < PEAK * float(cross.std()):
        return None
    down, right = (int(k) if k <= n // 2 else int(k) - n for k, n in zip(at, cross.shape, strict=True))
    return Problem(
        "warning",
        "shifted",
        capture,
        f"the image of capture {capture} fits its pattern when it is moved by {-down} rows and {-right} columns: crop "
        "the images that way, or register the camera",
    )


def _elsewhere(
    bench: Bench, samples: Sequence[Sample], predict: Predict, best: float, least: float
) -> Problem | None:
    """Whether the images fit their patterns at another distance."""
    found = best_distance(bench, samples, predict)
    if found is None or found.correlation < max(least, R_RATIO * max(best, 0.0)):
        return None
    stated = samples[0].plane_mm
    return Problem(
        "warning",
        "distance",
        "",
        f"the images fit their patterns at {found.distance_mm:.3g} mm (correlation {found.correlation:.2f}) and not at "
        f"the stated {stated:g} mm ({best:.2f}): correct the distance, or wavelength and pitch, which act alike",
    )


def _problem(capture: str, other: str, own: float, there: float) -> Problem:
    return Problem(
        "error",
        "mismatched",
        capture,
        f"the image of capture {capture} fits the pattern of capture {other} (correlation {there:.2f}) and not its own "
        f"({own:.2f}): put the right image in its row of captures.csv",
    )


def _nothing_fits(names: Sequence[str], best: float) -> Problem:
    return Problem(
        "error",
        "no_correlation",
        "",
        f"no image of the {len(names)} captures from {names[0]} to {names[-1]} fits any of their patterns (correlation "
        f"{best:.2f} at most): check that the images belong to these patterns, and distance, wavelength and pitch in "
        "bench.toml",
    )
