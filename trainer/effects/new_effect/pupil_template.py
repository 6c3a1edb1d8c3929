"""my_effect, an effect of the pupil: what the path passes or delays. It works as it is; edit it.

List it with the others:  hololoop-trainer effects --effects my_effect.py
Look for it in captures:  hololoop-trainer diagnose CAPTURES --effects my_effect.py
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trainer.effects import Parameter, Pupil, bare_stages, effect, pull


def _absorbing(pupil: Pupil, transmission: Tensor) -> Pupil:
    """The pupil with its transmission multiplied by a map [n, m]."""
    before = pupil.transmission
    return replace(pupil, transmission=transmission + 0j if before is None else before * transmission)


def _starts(evidence: Sequence[Any]) -> list[dict[str, float]]:
    """Where fits start: the row and the column that the residual would darken most."""
    pupil = bare_stages(evidence[0].scene).pupil
    v, u = pupil.v.reshape(-1).cpu().numpy(), pupil.u.reshape(-1).cpu().numpy()
    pulled = pull(evidence, "pupil", lambda p, m: _absorbing(p, 1 + m), (v.size, u.size))
    found = []
    for profile, place, angle in ((pulled.sum(1), v, 0.0), (pulled.sum(0), u, 90.0)):
        reach = max(1, round(0.04 * place.size))
        smooth = np.convolve(profile, np.ones(reach), mode="same")
        smooth[np.abs(place) > 0.95] = 0
        found.append({"depth": 0.3, "position": float(place[smooth.argmin()]), "angle": angle})
    return found


@effect(
    stage="pupil",
    # "display": the eye sees it too, so the headset corrects for it; "camera": only the camera does.
    acts_on="display",
    # One Parameter for each argument, in the same order. `scale` is a small but visible change.
    parameters=[
        Parameter(
            "depth", "1", scale=0.05, low=0, high=1, about="share of the amplitude that is lost in its middle"
        ),
        Parameter(
            "position", "share of band", scale=0.01, low=-1, high=1, about="distance from the pupil's centre"
        ),
        Parameter(
            "angle", "deg", scale=1.0, low=-45, high=135, about="0: along the rows; 90: along the columns"
        ),
        Parameter(
            "width", "share of band", scale=0.01, absent=0.05, low=0.005, high=0.5, about="half width at 1/e"
        ),
    ],
    starts=_starts,  # leave it out where a fit from "absent" converges by itself
)
def my_effect(pupil: Pupil, depth: Tensor, position: Tensor, angle: Tensor, width: Tensor) -> Pupil:
    """A thread across the pupil absorbs light."""
    # pupil.v [n, 1], pupil.u [1, m] are spatial frequencies in units of the panel's band; pupil.delayed(map)
    # adds a path difference in metres; pupil.filtered(transfer) blurs irradiance.
    turn = angle * (math.pi / 180)
    across = pupil.v * torch.cos(turn) + pupil.u * torch.sin(turn) - position
    return _absorbing(pupil, 1 - depth * torch.exp(-((across / width) ** 2)))
