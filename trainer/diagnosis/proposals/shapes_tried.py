"""Which shapes to try at which place: those that explain a part of a probe's map worth a fit."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from runtime.program.progress import Progress, no_progress
from trainer.captures.bench_file import Bench
from trainer.diagnosis.probes import ProbeResult
from trainer.diagnosis.proposals.blob_shape import blobs_in, blobs_of_their_own, more_blobs_in
from trainer.diagnosis.proposals.gray_shape import steps_in_gray
from trainer.diagnosis.proposals.probe_maps import (
    DRIVEN_BY_GRAY,
    GAIN,
    GRAY,
    TRANSMISSION,
    Place,
    ProbeMap,
    maps_of,
)
from trainer.diagnosis.proposals.product_shape import product_in, strength_of
from trainer.diagnosis.proposals.reading import Reading, Values
from trainer.diagnosis.proposals.row_column_shape import rows_and_columns_in
from trainer.diagnosis.proposals.surface_shape import radial_in, smooth_in, times_surface
from trainer.diagnosis.proposals.wave_shape import waves_in, waves_in_gray

MOST = 5  # shapes that are fitted in one round
LEAST = 0.02  # share of a map that a shape must explain
NODES = 6  # times a shape's numbers over the map's nodes, which it must explain: noise fits as much
SMOOTH = ("surface", "radial")  # a surface's product with a surface is one again
WEAK = 0.1  # of the best candidate's worth: what is below is not fitted

Read = Callable[[ProbeMap], list[Reading]]


@dataclass(frozen=True)
class Candidate:
    """A shape at a place.

    Attributes
    ----------
    place : Place
    reading : Reading
    worth : float
        Held-out excess that it may remove: the probe's, times its share of the maps.
    """

    place: Place
    reading: Reading
    worth: float

    def name(self, taken: Collection[str]) -> str:
        """A name for its effect that is not taken."""
        parts = [self.place.stage, self.reading.name]
        if self.place.name and self.place not in (GAIN, GRAY):
            parts.insert(1, self.place.name)
        stem = "_".join(parts)[:48]
        names = [stem, *(f"{stem}_{k}" for k in range(2, 100))]
        return next(n for n in names if n not in taken)


def candidates_of(
    probes: Sequence[ProbeResult], bench: Bench, signal: float, progress: Progress | None = None
) -> list[Candidate]:
    """Shapes that the probes' maps show, those that promise most first.

    Parameters
    ----------
    probes : sequence of ProbeResult
        Those that remove something.
    bench : Bench
    signal : float, counts
        Standard deviation of the measured signal.
    """
    report = progress or no_progress
    maps = _maps(probes, bench, signal)
    found: list[Candidate] = []
    for k, one in enumerate(maps):
        report(k / len(maps), f"looking at the {one.place.stage} probe")
        found += [Candidate(one.place, r, one.weight * r.explained) for r in readings_of(one)]
    found.sort(key=lambda c: -c.worth)
    return [c for c in found if c.worth > WEAK * found[0].worth][:MOST]


def readings_of(one: ProbeMap) -> list[Reading]:
    """Shapes and the best product of two that explain a part of a map worth a fit, those that explain most first."""
    readings = single_shapes(one)
    seen = [*readings, *(p for p in _best_product(one, readings) if _worth_a_fit(one, p))]
    seen.sort(key=lambda r: -r.explained)
    if one.place is DRIVEN_BY_GRAY:  # smooth ones have a name: phase_nonuniformity
        return [r for r in seen[:1] if r.name not in SMOOTH]
    return seen


def single_shapes(one: ProbeMap) -> list[Reading]:
    """Shapes that explain a part of a map worth a fit, those that explain most first."""
    readings = [r for read in _readers(one.place) for r in read(one) if _worth_a_fit(one, r)]
    return sorted(readings, key=lambda r: -r.explained)


def _worth_a_fit(one: ProbeMap, reading: Reading) -> bool:
    return reading.explained > max(LEAST, NODES * reading.size / one.values.size)


def _best_product(one: ProbeMap, readings: Sequence[Reading]) -> list[Reading]:
    """The product of two shapes that explains most: any times a surface, or the first times what its strength shows."""
    firsts = [r for r in readings if r.name not in (*SMOOTH, "specks")] if one.place is not GRAY else []
    products = [times_surface(one, r) for r in firsts]
    if firsts:
        strength = strength_of(one, firsts[0])
        seconds = [r for read in (waves_in, radial_in, *_repeating(one.place)) for r in read(strength)]
        products += [product_in(one, firsts[0], r) for r in seconds if _worth_a_fit(strength, r)]
    found = [p for p in products if p is not None]
    # A factor of many numbers explains more by chance.
    return sorted(found, key=lambda p: NODES * p.size / one.values.size - p.explained)[:1]


def _repeating(place: Place) -> tuple[Read, ...]:
    return (rows_and_columns_in,) if place.spread == "pixels" else ()


def more_of(
    candidate: Candidate, probe: ProbeResult, bench: Bench, values: Values, own: bool
) -> Candidate | None:
    """The candidate's fitted specks with more freedom.

    Parameters
    ----------
    probe : ProbeResult
        Of what is left with the specks.
    values : mapping
        The specks' fitted numbers.
    own : bool
        Each with its own transmission; otherwise with the specks that the probe shows beside them, if it shows any.
    """
    (one,) = (m for m in _maps([probe], bench, 1.0) if m.place is candidate.place)
    found = [blobs_of_their_own(one, values)] if own else more_blobs_in(one, values)
    return Candidate(candidate.place, found[0], candidate.worth) if found else None


def _maps(probes: Sequence[ProbeResult], bench: Bench, signal: float) -> list[ProbeMap]:
    shapes = {p.stage: bench.camera.shape if p.stage == "sensor" else bench.panel.shape for p in probes}
    return [m for p in probes for m in maps_of(p, shapes[p.stage], signal, bench.panel.phase_sign)]


def _readers(place: Place) -> tuple[Read, ...]:
    if place is TRANSMISSION:
        return (blobs_in,)
    if place is GRAY:
        return (waves_in_gray, steps_in_gray)
    smooth: tuple[Read, ...] = (waves_in, smooth_in, radial_in)
    if place.spread != "pixels":
        return smooth
    return (*smooth, rows_and_columns_in, *((blobs_in,) if place in (GAIN, DRIVEN_BY_GRAY) else ()))
