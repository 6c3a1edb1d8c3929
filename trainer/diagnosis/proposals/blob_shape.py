"""Sparse shapes in a probe's map: dust and dead pixels, each with its place and its size."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt, label, uniform_filter

from trainer.diagnosis.proposals.probe_maps import TRANSMISSION, ProbeMap
from trainer.diagnosis.proposals.reading import Number, Reading, Values, share_explained
from trainer.formatting import number

ABOVE = 6.0  # of the map's noise: what is a blob
MOST_BLOBS = 120
MOST_TOUCHING = 6  # discs in one blob
OUTSIDE, APART = (
    0.6,
    0.5,
)  # a further disc: most of it, and its centre by so many pixels, outside the fitted ones
MOST_AREA = 0.2  # share of a map that blobs may cover: more is no sparse shape
LEAST_RADIUS = 0.5  # of a node's distance: a dead pixel is a disc of 0.56
LEAST_STRENGTH = 0.08  # of the middle blob: weaker ones are the descent's own


Mask = NDArray[np.bool_]
Found = tuple[list[float], list[float], list[float], complex]  # rows, columns, radii, what passes


def blobs_in(one: ProbeMap) -> list[Reading]:
    """The discs of a map, complex or of a camera's gain, that all pass the same."""
    found = _found(one)
    return [] if found is None else [_reading(one, found, False)]


def blobs_of_their_own(one: ProbeMap, values: Values) -> Reading:
    """The discs that were fitted, each with its own transmission.

    Parameters
    ----------
    one : ProbeMap
        Of the place where the discs are.
    values : mapping
        As in `more_blobs_in`.
    """
    places = tuple([float(v) for v in np.asarray(values[n])] for n in ("row", "column", "radius"))
    return _reading(one, (places[0], places[1], places[2], _passing(values)), True)


def more_blobs_in(one: ProbeMap, values: Values) -> list[Reading]:
    """The discs that were fitted, and those that the map of what is left shows beside them.

    Parameters
    ----------
    one : ProbeMap
        Of a probe that was fitted with the discs in the model.
    values : mapping
        The fitted discs': `row`, `column`, `radius`, and `real` and `imaginary` or `passed`.
    """
    inside = _passing(values)
    found = _found(one, inside)
    rows, columns, radii = (np.asarray(values[n], dtype=float) for n in ("row", "column", "radius"))
    fresh = []
    for row, column, radius, *_ in zip(*found[:3], strict=True) if found else ():
        if (np.hypot(rows - row, columns - column) > radii + OUTSIDE * radius + APART).all():
            fresh.append((row, column, radius))
    if not fresh:
        return []
    together = [
        [*known.tolist(), *new]
        for known, new in zip((rows, columns, radii), zip(*fresh, strict=True), strict=True)
    ]
    return [_reading(one, (together[0], together[1], together[2], inside), False)]


def _passing(values: Values) -> complex:
    """What passes the fitted discs, on average."""
    names = ("passed",) if "passed" in values else ("real", "imaginary")
    return complex(*(float(np.mean(values[n])) for n in names))


def _reading(one: ProbeMap, found: Found, own: bool) -> Reading:
    rows, columns, radii, inside = found
    count = len(rows)
    y, x = one.grid
    shape = np.ones(one.values.shape, dtype=one.values.dtype)
    for k in range(count):
        covered = np.clip(radii[k] + 0.5 - np.hypot(y - rows[k], x - columns[k]), 0, 1)
        shape = shape * (1 + covered * (inside - 1))
    shape = shape - 1
    is_complex = one.place is TRANSMISSION
    spread = one.place.spread
    places = (
        Number("row", spread, 0.2, tuple(rows), 0.0, -1e4, 1e4, "of each disc's centre, from the middle"),
        Number(
            "column", spread, 0.2, tuple(columns), 0.0, -1e4, 1e4, "of each disc's centre, from the middle"
        ),
        Number("radius", spread, 0.2, tuple(radii), 1.0, 0.2, 1e3, "of each disc"),
    )

    def of_each(value: float) -> float | tuple[float, ...]:
        return (float(value),) * count if own else float(value)

    whose = "of each disc" if own else "of the discs"
    what = "phase" if one.place.stage == "drive" else "light"
    passed: tuple[Number, ...]
    if is_complex:
        passed = (
            Number(
                "real", "1", 0.05, of_each(inside.real), 1.0, -2.0, 2.0, f"part of what passes {whose}", True
            ),
            Number(
                "imaginary",
                "1",
                0.05,
                of_each(inside.imag),
                0.0,
                -2.0,
                2.0,
                f"part of what passes {whose}",
                True,
            ),
        )
        line = "    inside = torch.complex(real, imaginary)"
    else:
        passed = (
            Number("passed", "1", 0.05, of_each(inside.real), 1.0, 0.0, 10.0, f"of the {what} {whose}", True),
        )
        line = "    inside = passed"

    def described(values: Values) -> str:
        radius = (
            f"radius {number(float(np.min(values['radius'])))} to {number(float(np.max(values['radius'])))}"
        )
        if not is_complex:
            passed_light = number(float(np.mean(values["passed"])))
            return f"{count} specks of {radius} {spread} that pass {passed_light} of the {what}"
        factor = complex(np.mean(values["real"]), np.mean(values["imaginary"]))
        turn = number(math.degrees(np.angle(factor)))
        size = number(abs(factor))
        return f"{count} specks of {radius} {spread} that pass {size} of the amplitude, turned by {turn} deg"

    return Reading(
        name="specks_of_their_own" if own else "specks",
        about="Specks: small discs that absorb and delay.",
        describe=described,
        formula=r"v = \prod_k \left[1 + c_k(y, x)\,(\tau"
        + ("_k" if own else "")
        + r" - 1)\right] - 1,\quad c_k = \mathrm{clip}\left(r_k + \tfrac12 - "
        r"\sqrt{(y-y_k)^2 + (x-x_k)^2},\,0,\,1\right)",
        numbers=(*places, *passed),
        code=(line, "    value = discs(y, x, row, column, radius, inside) - 1"),
        found=shape,
        explained=share_explained(one.values, shape),
        imports=("from trainer.effects import discs",),
    )


def _found(one: ProbeMap, known: complex | None = None) -> Found | None:
    """The blobs, of which what passes may be `known`; None where the map is not sparse."""
    strength = np.abs(uniform_filter(one.values.real, 3) + 1j * uniform_filter(one.values.imag, 3))
    noise = float(np.median(strength)) / 0.8  # of a map that is noise nearly everywhere
    if noise <= 0:
        return None
    above = strength > ABOVE * noise
    if not above.any() or above.mean() > MOST_AREA:
        return None
    marked, count = label(above)
    if count > 4 * MOST_BLOBS:
        return None
    y, x = one.grid
    steps = [2 * r / (n - 1) for r, n in zip(one.reach, one.values.shape, strict=True)]
    cores = [(strength * (marked == k)).max() for k in range(1, count + 1)]
    order = [k + 1 for k in np.argsort(cores)[::-1][:MOST_BLOBS]]
    deep = one.values[strength > 0.7 * np.max(cores)]
    inside = 1 + complex(deep.mean()) if known is None else known
    full = abs(inside - 1)
    rows, columns, radii = [], [], []
    for k in order:
        if cores[k - 1] < LEAST_STRENGTH * full:
            continue
        whole = _grown(marked == k)
        for part in _parts(whole, binary_fill_holes(whole & (strength > 0.5 * full))):
            weight = np.maximum(np.abs(one.values) * part - 2 * noise, 0)
            mass = float(weight.sum())
            radius = math.sqrt(mass * steps[0] * steps[1] / (math.pi * full))
            if radius < LEAST_RADIUS * steps[0]:
                continue
            rows.append(float((weight * y).sum() / mass))
            columns.append(float((weight * x).sum() / mass))
            radii.append(radius)
    return (rows, columns, radii, inside) if rows else None


def _parts(whole: Mask, solid: Mask) -> list[Mask]:
    """A blob divided into the discs that touch in it: each has a centre that is far from the solid part's rim."""
    depth = distance_transform_edt(solid)
    k, m = np.indices(whole.shape)
    discs: list[tuple[int, int, float]] = []
    while len(discs) < MOST_TOUCHING:
        at = np.unravel_index(int(depth.argmax()), depth.shape)
        deepest = float(depth[at])
        if deepest < (0.5 * discs[0][2] if discs else 1.0) or (deepest < 1.5 and discs):
            break
        discs.append((int(at[0]), int(at[1]), deepest))
        # What lies within a disc, or within a rim's roughness of it, is no centre of another.
        depth = np.where(np.hypot(k - at[0], m - at[1]) < 1.25 * deepest + 0.5, 0, depth)
    if len(discs) < 2:
        return [whole]
    nearest = np.argmin([np.hypot(k - row, m - column) - size for row, column, size in discs], axis=0)
    return [whole & (nearest == n) for n in range(len(discs))]


def _grown(mark: Mask) -> Mask:
    """A mark and its neighbours: a blob's rim is below the noise's multiple."""
    return np.asarray(uniform_filter(mark.astype(np.float64), 3) > 1e-6)
