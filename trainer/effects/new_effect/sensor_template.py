"""my_effect, an effect of the sensor: from irradiance to counts. It works as it is; edit it.

List it with the others:  hololoop-trainer effects --effects my_effect.py
Look for it in captures:  hololoop-trainer diagnose CAPTURES --effects my_effect.py
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from trainer.effects import Parameter, Sensor, effect, pull, waves


def _starts(evidence: Sequence[Any]) -> list[dict[str, float]]:
    """Where fits start: the fringes to which the residual pulls most."""
    shape = evidence[0].scene.bench.camera.shape
    pulled = pull(evidence, "sensor", lambda sensor, gain: sensor.multiplied(1 + gain), shape)
    found = []
    for wave in waves(pulled):
        fy, fx = wave.frequency
        period, angle = 1 / math.hypot(fy, fx), math.degrees(math.atan2(fy, fx))
        found.append(
            {"cosine": 0.05 * wave.cosine, "sine": 0.05 * wave.sine, "period": period, "angle": angle}
        )
    return found


@effect(
    stage="sensor",
    # "display": the eye sees it too, so the headset corrects for it; "camera": only the camera does.
    acts_on="camera",
    # One Parameter for each argument, in the same order. `scale` is a small but visible change.
    parameters=[
        Parameter(
            "cosine",
            "1",
            scale=0.02,
            low=-1,
            high=1,
            about="fringes that are even about the picture's centre",
        ),
        Parameter(
            "sine", "1", scale=0.02, low=-1, high=1, about="fringes that are odd about the picture's centre"
        ),
        Parameter("period", "pixels", scale=0.05, absent=20, low=2, high=2000, about="from fringe to fringe"),
        Parameter(
            "angle",
            "deg",
            scale=0.2,
            low=-100,
            high=100,
            about="direction across the fringes; 0: along a row",
        ),
    ],
    starts=_starts,  # leave it out where a fit from "absent" converges by itself
)
def my_effect(sensor: Sensor, cosine: Tensor, sine: Tensor, period: Tensor, angle: Tensor) -> Sensor:
    """Fringes lie over the picture, as from the camera's cover glass."""
    # sensor.y, sensor.x [rows, columns] run over -1 .. 1. Besides multiplied(map) there are
    # brightened(counts), blurred(transfer), displaced(dy, dx) and responding(curve); see trainer/prediction/stages.py.
    rows, columns = sensor.y.shape
    turn = angle * (math.pi / 180)
    along = sensor.x * (columns / 2) * torch.cos(turn) + sensor.y * (rows / 2) * torch.sin(turn)
    phase = 2 * math.pi * along / period
    return sensor.multiplied(1 + cosine * torch.cos(phase) + sine * torch.sin(phase))
