"""my_effect, an effect of the panel: a fixed field, a factor on the light or added to it. It works as it is; edit it.

List it with the others:  hololoop-trainer effects --effects my_effect.py
Look for it in captures:  hololoop-trainer diagnose CAPTURES --effects my_effect.py
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from trainer.effects import Panel, Parameter, effect, pull, waves


def _starts(evidence: Sequence[Any]) -> list[dict[str, float]]:
    """Where fits start: the stripes to which the residual pulls most."""
    columns = evidence[0].scene.bench.panel.width
    pulled = pull(evidence, "panel", lambda panel, row: panel.multiplied(1 + row[None, :]), (columns,))
    return [
        {"cosine": 0.05 * w.cosine, "sine": 0.05 * w.sine, "period": 1 / w.frequency[0]}
        for w in waves(pulled)
    ]


@effect(
    stage="panel",
    # "display": the eye sees it too, so the headset corrects for it; "camera": only the camera does.
    acts_on="display",
    # One Parameter for each argument, in the same order. `scale` is a small but visible change.
    parameters=[
        Parameter(
            "cosine",
            "1",
            scale=0.02,
            low=-0.9,
            high=0.9,
            about="stripes that are even about the middle column",
        ),
        Parameter(
            "sine", "1", scale=0.02, low=-0.9, high=0.9, about="stripes that are odd about the middle column"
        ),
        Parameter(
            "period", "pixels", scale=0.02, absent=16, low=2, high=2000, about="columns from stripe to stripe"
        ),
    ],
    starts=_starts,  # leave it out where a fit from "absent" converges by itself
)
def my_effect(panel: Panel, cosine: Tensor, sine: Tensor, period: Tensor) -> Panel:
    """The panel's columns differ in amplitude by a regular stripe."""
    # panel.y, panel.x [rows, columns] run over -1 .. 1. Use panel.multiplied(map), real or complex, for what
    # the panel does to all light, and panel.leaking(field) for light that the pattern does not modulate.
    column = panel.x * panel.x.shape[1] / 2
    angle = 2 * math.pi * column / period
    return panel.multiplied(1 + cosine * torch.cos(angle) + sine * torch.sin(angle))
