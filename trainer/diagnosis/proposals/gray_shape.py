"""Functions of the gray level: a low-order curve, and a free one as straight lines between steps."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre

from trainer.diagnosis.proposals.probe_maps import ProbeMap
from trainer.diagnosis.proposals.reading import Number, Reading, rms, share_explained
from trainer.formatting import number

ORDER = 3  # of the curve
STEPS = 17


def smooth_in_gray(one: ProbeMap) -> list[Reading]:
    """The response's deviation as a low-order curve, without its mean."""
    level = 2 * np.linspace(0, 1, one.values.size) - 1
    basis = legendre.legvander(level, ORDER)[:, 1:]
    values = one.values - one.values.mean()
    seen = np.linalg.lstsq(basis, values, rcond=None)[0]
    shape = basis @ seen
    return [
        Reading(
            name="curve",
            about="The phase of the gray levels deviates by a smooth curve.",
            describe=lambda v: (
                f"a curve of order {ORDER} over the gray levels, terms of "
                f"{number(float(np.hypot.reduce(v['terms'])))} rad in all"
            ),
            formula=r"v = \sum_{n \geq 1} a_n P_n(2g - 1)",
            numbers=(
                Number(
                    "terms",
                    "rad",
                    0.05,
                    tuple(float(v) for v in seen),
                    0.0,
                    -10.0,
                    10.0,
                    f"of Legendre polynomials of orders 1 to {ORDER}",
                    True,
                ),
            ),
            code=(f"    value = terms @ legendre_curve(2 * level - 1, {ORDER + 1})[1:]",),
            found=shape,
            explained=share_explained(one.values, shape),
            imports=("from runtime.lightpath.legendre import legendre_curve",),
        )
    ]


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
