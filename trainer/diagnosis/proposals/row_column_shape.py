"""Shapes that repeat by column or by row: each its own number, or one that comes again every 2, 3 or 4."""

from __future__ import annotations

import numpy as np

from trainer.diagnosis.proposals.probe_maps import ProbeMap
from trainer.diagnosis.proposals.reading import Array, Number, Reading, rms, share_explained, with_unit

EVERY = (2, 3, 4)
AXES = {"column": 1, "row": 0}


def rows_and_columns_in(one: ProbeMap) -> list[Reading]:
    """Profiles by column and by row, and what repeats in them every few."""
    found: list[Reading] = []
    for kind, axis in AXES.items():
        profile = one.values.mean(axis=1 - axis) - one.values.mean()
        if one.whole:
            found += [_repeating(one, kind, axis, profile, every) for every in EVERY]
        found.append(_each(one, kind, axis, profile))
    return found


def _each(one: ProbeMap, kind: str, axis: int, profile: Array) -> Reading:
    count = one.shape[axis]
    places = np.linspace(0, profile.size - 1, count)
    seen = np.interp(places, np.arange(profile.size), profile)
    shape = _spread(profile, axis, one.values.shape)
    unit = one.place.unit
    return Reading(
        name=f"{kind}s",
        about=f"Each {kind} has its own number, as {kind} drivers that differ make it.",
        describe=lambda v: f"{count} {kind}s that differ by {with_unit(rms(v['each']), unit)} rms",
        formula=r"v_{" + ("x" if axis else "y") + r"} = a_{" + ("x" if axis else "y") + "}",
        numbers=(
            Number(
                "each",
                unit,
                _scale(unit, profile),
                tuple(float(v) for v in seen),
                0.0,
                *_range(unit),
                f"of each {kind}",
                True,
            ),
        ),
        code=(f"    value = each[{'None, :' if axis else ':, None'}].expand(rows, columns)",),
        found=shape,
        explained=share_explained(one.values, shape),
    )


def _repeating(one: ProbeMap, kind: str, axis: int, profile: Array, every: int) -> Reading:
    index = np.arange(profile.size) % every
    means = np.array([profile[index == k].mean() for k in range(every)])
    shape = _spread(means[index], axis, one.values.shape)
    unit = one.place.unit
    others = means[1:] - means[0]
    along = "columns" if axis else "rows"
    return Reading(
        name=f"{kind}s_every_{every}",
        about=f"Every {every} {kind}s the same error comes again, as drivers that take turns make it.",
        describe=lambda v: (
            f"an error that repeats every {every} {kind}s: "
            + ", ".join(with_unit(float(a), unit) for a in (0.0, *v["others"]))
        ),
        formula=r"v_k = a_{k \bmod " + str(every) + "}",
        numbers=(
            Number(
                "others",
                unit,
                _scale(unit, means),
                tuple(float(v) for v in others),
                0.0,
                *_range(unit),
                f"of the second {kind} of each group and those after it; the first has 0",
                True,
            ),
        ),
        code=(
            "    group = torch.cat((torch.zeros(1, dtype=others.dtype), others))",
            f"    repeated = group[torch.arange({along}) % {every}]",
            f"    value = repeated[{'None, :' if axis else ':, None'}].expand(rows, columns)",
        ),
        found=shape,
        explained=share_explained(one.values, shape),
    )


def _spread(profile: Array, axis: int, shape: tuple[int, ...]) -> Array:
    return np.broadcast_to(profile[None, :] if axis else profile[:, None], shape)


def _scale(unit: str, values: Array) -> float:
    return 0.02 if unit != "counts" else float(f"{max(0.2 * values.std(), 0.1):.2g}")


def _range(unit: str) -> tuple[float, float]:
    return {"1": (-1.0, 5.0), "rad": (-10.0, 10.0)}.get(unit, (-1e4, 1e4))
