"""How well light paths predict captures that no fit has seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, gain_of
from runtime.calibration.prediction import Predictor
from runtime.excess import PredictionErrors, joined, prediction_errors


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors of an estimate on held-out captures.

    Attributes
    ----------
    errors : PredictionErrors
        Over all captures.
    residuals : tuple of float32 arrays [h, w]
        The error of each capture, in standard deviations of its noise.
    """

    errors: PredictionErrors
    residuals: tuple[np.ndarray, ...]


def held_out_errors(
    bases: Mapping[str, ColourLightPath], shots: Sequence[Shot], estimate: Estimate
) -> HeldOutErrors:
    """Errors of an estimate on shots that no fit has seen.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    shots : sequence of Shot
        Each is predicted with its own best gain.
    estimate : Estimate
    """
    parts: list[PredictionErrors] = []
    residuals: list[np.ndarray] = []
    for channel, own in groupby(shots, lambda shot: shot.channel):
        predictor = Predictor({channel: bases[channel]})  # the buffers of one colour at a time
        predictor.take(estimate)
        for shot in own:
            light = predictor.light(shot)
            prediction = gain_of(shot, light) * light
            signal, weight = shot.signal, shot.weight  # each is made anew when it is asked for
            mask = weight > 0
            noise = np.divide(1, weight, out=np.zeros(weight.shape, np.float64), where=mask)
            arrays = (a.astype(np.float64)[None] for a in (signal, prediction, noise, mask))
            parts.append(prediction_errors([f"{len(parts):03d}"], *arrays))
            error = np.where(mask, signal - prediction, 0)
            residuals.append((error * np.sqrt(weight)).astype(np.float32))
    return HeldOutErrors(joined(parts), tuple(residuals))
