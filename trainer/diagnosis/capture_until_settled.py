"""Captures chosen, taken on a bench and diagnosed again, until nothing is in doubt that captures could decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from runtime.program.progress import Progress, no_progress, part_of
from trainer.captures.acquire import EXPOSURES_MS, Headset
from trainer.captures.capture_set import CaptureSet
from trainer.captures.further_captures import new_ids, planes_in_reach, take_further
from trainer.captures.possible_captures import possible_captures
from trainer.diagnosis.capture_choice import NextCaptures, next_captures, settled
from trainer.diagnosis.doubts import Doubts, doubts_of
from trainer.diagnosis.separate import PLANES
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.pool import Pool
from trainer.model.model import Model

A_ROUND = 2  # captures between two diagnoses: one to fit and one to judge, where a colour and plane is new


@dataclass(frozen=True)
class NextRound:
    """What is in doubt of a capture set, and the captures that say most of it.

    Attributes
    ----------
    captures : CaptureSet
        What the doubts are of.
    found : NextCaptures
        Chosen, and not taken.
    taken : tuple of dict
        Rows, as of the key `captures` of `next --json`, of captures that were taken in rounds before.
    """

    captures: CaptureSet
    doubts: Doubts
    found: NextCaptures
    taken: tuple[dict[str, Any], ...] = ()

    @property
    def settled(self) -> bool:
        """Whether further captures have nothing to decide."""
        return settled(self.doubts, self.found.parameter_excess)


def near_planes(captures: CaptureSet) -> list[float]:
    """The planes of a set, mm, and two others about the first of them."""
    first = captures.captures[0].plane_mm
    return [*captures.planes, *(first * share for share in PLANES)]


def choose_next(
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    count: int,
    planes_mm: Sequence[float] = (),
    seed: int = 0,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    limits_ms: tuple[float, float] = EXPOSURES_MS,
) -> NextRound:
    """What is in doubt, and the captures that say most of it.

    Parameters
    ----------
    count : int
        How many captures to choose.
    planes_mm : sequence of float, mm
        Planes to choose from; by default those of the set and two others.
    seed : int
        Of the random patterns.
    progress : callable, optional
        Called with the share that is done and what is being done.
    limits_ms : (float, float), ms
        The shortest and the longest exposure.

    Raises
    ------
    InputError
        Where no pattern reaches the planes.
    """
    report = progress or no_progress
    planes = [float(p) for p in planes_mm] or near_planes(captures)
    possible = possible_captures(captures, planes, count, seed, limits_ms)
    doubts = doubts_of(captures, model, known, pool, thresholds, part_of(report, 0.0, 0.6))
    found = next_captures(captures, doubts, possible, count, pool, part_of(report, 0.6, 1.0))
    return NextRound(captures, doubts, found)


def capture_until_settled(
    headset: Headset,
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    count: int,
    planes_mm: Sequence[float],
    seed: int = 0,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
) -> NextRound:
    """Show and capture what says most, and diagnose again, until the verdict is settled or `count` captures are taken.

    Parameters
    ----------
    headset : Headset
    captures : CaptureSet
        The further captures are appended to it.
    count : int
        Captures at most.
    planes_mm : sequence of float, mm
        To choose from; those out of the bench's reach are left out.

    Returns
    -------
    NextRound
        The last one.
    """
    report = progress or no_progress
    planes = planes_in_reach(headset, planes_mm)
    limits = (EXPOSURES_MS[0], min(EXPOSURES_MS[1], headset.camera.longest_exposure_ms))
    taken: list[dict[str, Any]] = []
    while True:
        done = len(taken) / (count + A_ROUND)
        part = part_of(report, done, done + A_ROUND / (count + A_ROUND), f"{len(taken)} captures taken")
        asked = min(A_ROUND, count - len(taken))
        last = choose_next(
            captures, model, known, pool, asked, planes, seed + len(taken), thresholds, part, limits
        )
        if last.settled or not last.found.chosen:
            return NextRound(captures, last.doubts, last.found, tuple(taken))
        names = new_ids(captures, asked)
        rows = [
            one.as_json(name, f"phase/{len(captures) + k:04d}.png")
            for k, (name, one) in enumerate(zip(names, last.found.chosen, strict=False))
        ]
        grays = [one.gray for one in last.found.chosen]
        captures = take_further(headset, captures, list(zip(rows, grays, strict=True)))
        taken += rows
