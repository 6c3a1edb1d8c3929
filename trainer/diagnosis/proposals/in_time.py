"""Shapes whose strength is a function of the captures' order or time: read where a map drifts, or on a steady shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trainer.captures.capture_table import Capture, ids_of
from trainer.captures.held_out import CaptureRoles, split
from trainer.diagnosis.proposals.drifting_maps import FREE, drifting_maps, strengths_of
from trainer.diagnosis.proposals.gray_shape import smooth_in_gray
from trainer.diagnosis.proposals.order_shape import LEAST_CAPTURES, Strengths, curves_in
from trainer.diagnosis.proposals.probe_maps import GRAY, OFFSET, Place, ProbeMap, map_at
from trainer.diagnosis.proposals.product_shape import product
from trainer.diagnosis.proposals.reading import Reading
from trainer.diagnosis.proposals.shapes_tried import Candidate, single_shapes
from trainer.diagnosis.proposals.surface_shape import smooth_in
from trainer.effects.definition import STAGES
from trainer.fitting.pool import Pool
from trainer.model.model import Model

CAPTURES = 24  # most that strengths are read off
MOST = 3  # products that are fitted in one round
LIGHT_ORDER = 4  # of added light that changes
STEADY, A_MAP, CURVES = 2, 2, 2  # shapes of the steady probes, shapes of a drifting map, curves of a shape


def read_captures_in_time(roles: CaptureRoles) -> tuple[Capture, ...]:
    """The captures that strengths are read off: those that are not held out, evenly from the first to the last."""
    rows = split(roles.captures).fitted
    places = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), CAPTURES)).round().astype(int))
    return tuple(rows[k] for k in places)


def candidates_in_time(
    roles: CaptureRoles, model: Model, pool: Pool, steady: Sequence[Candidate]
) -> list[Candidate]:
    """Shapes times a curve over the captures, those that promise most first.

    Only shapes that were seen are tried: the steady ones, and those of the maps that drift.

    Parameters
    ----------
    steady : sequence of Candidate
        Shapes that the probes show, those that promise most first.
    """
    ids = ids_of(read_captures_in_time(roles))
    if len(ids) < LEAST_CAPTURES:
        return []
    maps = pool.map(drifting_maps, [(roles.folder, ids, model, stage) for stage in STAGES])
    shapes: list[tuple[Place, Reading]] = [
        (c.place, c.reading) for c in steady if c.place in FREE and "_times_" not in c.reading.name
    ][:STEADY]
    for one in (m for found in maps for m in found):
        size = model.bench.camera.shape if one.place.stage == "sensor" else model.bench.panel.shape
        drifting = map_at(one.place, one.values, size)
        named = _named_when_steady(drifting)
        others = [r for r in single_shapes(drifting) if r.name not in (n.name for n in named)]
        shapes += [(one.place, r) for r in [*named, *others][:A_MAP]]
    tasks = [(roles.folder, ids, model, place, reading.found) for place, reading in shapes]
    found = []
    for (place, reading), (seen, variance) in zip(shapes, pool.map(strengths_of, tasks), strict=True):
        for strength, curve in curves_in(seen)[:CURVES]:
            whole = product(reading.scaled(strength), curve, strength * reading.found, reading.explained)
            found.append(Candidate(place, whole, _removed(seen, strength * curve.found) / variance))
    found.sort(key=lambda c: -c.worth)
    return found[:MOST]


def _named_when_steady(one: ProbeMap) -> list[Reading]:
    """Shapes that have a name where they are steady, `phase_response` and `stray_light`, and none where they drift."""
    if one.place is GRAY:
        return smooth_in_gray(one)
    return smooth_in(one, LIGHT_ORDER, lowest=0) if one.place is OFFSET else []


def _removed(seen: Strengths, fitted: np.ndarray) -> float:
    """Squared error that strengths remove."""
    return float((seen.weights * (seen.values**2 - (seen.values - fitted) ** 2)).sum())
