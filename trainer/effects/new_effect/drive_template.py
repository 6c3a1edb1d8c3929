"""my_effect, an effect of the drive: from gray level to phase. It works as it is; edit it.

List it with the others:  hololoop-trainer effects --effects my_effect.py
Look for it in captures:  hololoop-trainer diagnose CAPTURES --effects my_effect.py
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from trainer.effects import Drive, Parameter, effect, pull, waves


def _starts(evidence: Sequence[Any]) -> list[dict[str, float]]:
    """Where fits start: the ripples of the response to which the residual pulls most."""
    pulled = pull(
        evidence, "drive", lambda drive, curve: replace(drive, response=drive.response + curve), (256,)
    )
    levels = float(evidence[0].scene.bench.panel.levels)
    return [
        {"cosine": 0.1 * w.cosine, "sine": 0.1 * w.sine, "cycles": w.frequency[0] * levels}
        for w in waves(pulled)
    ]


@effect(
    stage="drive",
    # "display": the eye sees it too, so the headset corrects for it; "camera": only the camera does.
    acts_on="display",
    # One Parameter for each argument, in the same order. `scale` is a small but visible change.
    parameters=[
        Parameter(
            "cosine",
            "rad",
            scale=0.05,
            low=-3,
            high=3,
            about="part of the ripple that is even about mid-gray",
        ),
        Parameter(
            "sine", "rad", scale=0.05, low=-3, high=3, about="part of the ripple that is odd about mid-gray"
        ),
        Parameter(
            "cycles", "1", scale=0.1, absent=8, low=0.5, high=64, about="ripples in one wave of gray levels"
        ),
    ],
    starts=_starts,  # leave it out where a fit from "absent" converges by itself
)
def my_effect(drive: Drive, cosine: Tensor, sine: Tensor, cycles: Tensor) -> Drive:
    """The display's look-up table is off by a ripple."""
    # drive.level [256] is gray / levels; drive.response [256] is the phase in radians; drive.y, drive.x
    # [rows, columns] run over -1 .. 1 across the panel, for maps (see Drive.scaled).
    angle = 2 * math.pi * cycles * (drive.level - drive.level.mean())
    return replace(drive, response=drive.response + cosine * torch.cos(angle) + sine * torch.sin(angle))
