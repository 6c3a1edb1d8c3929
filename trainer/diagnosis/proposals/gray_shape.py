"""A free function of the gray level, as straight lines between steps."""

from __future__ import annotations

import numpy as np

from trainer.diagnosis.proposals.probe_maps import ProbeMap
from trainer.diagnosis.proposals.reading import Number, Reading, rms, share_explained
from trainer.formatting import number

STEPS = 17


def steps_in_gray(one: ProbeMap) -> list[Reading]:
    """The response's deviation at equal steps of the gray level."""
    nodes = np.linspace(0, 1, one.values.size)
    knots = np.linspace(0, 1, STEPS)
    tents = np.clip(1 - np.abs(nodes[:, None] - knots[None, :]) * (STEPS - 1), 0, None)
    seen = np.linalg.lstsq(tents, one.values, rcond=None)[0]
    shape = tents @ seen
    return [
        Reading(
            name="steps",
            about="The phase of the gray levels deviates by a free curve.",
            describe=lambda v: f"a curve over the gray levels, {number(rms(v['knots']))} rad rms",
            formula=r"v = \sum_k a_k \Lambda\left((K - 1) g - k\right)",
            numbers=(
                Number(
                    "knots",
                    "rad",
                    0.05,
                    tuple(float(v) for v in seen),
                    0.0,
                    -10.0,
                    10.0,
                    "at equal steps of the gray level",
                    True,
                ),
            ),
            code=(
                f"    apart = torch.abs(level[:, None] * {STEPS - 1} - torch.arange({STEPS}))",
                "    value = torch.clamp(1 - apart, min=0) @ knots",
            ),
            found=shape,
            explained=share_explained(one.values, shape),
        )
    ]
