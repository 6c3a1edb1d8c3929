"""The captures that say most of what is in doubt: chosen one after the other by what each adds to those before it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.program.progress import Progress, no_progress
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import holds_out
from trainer.captures.patterns import Gray
from trainer.captures.possible_captures import PossibleCapture
from trainer.diagnosis.doubts import Doubts
from trainer.diagnosis.expected_information import (
    MOST_SATURATED,
    ExpectedInformation,
    covariance,
    information_of_captures,
    information_of_possible,
    prior,
)
from trainer.fitting.jacobian import keys_of
from trainer.fitting.pool import Pool
from trainer.formatting import number

Scene = tuple[str, float]
NEVER = 1e3  # captures: the price where the last one would be held out


@dataclass(frozen=True)
class NextCapture:
    """A capture to take.

    Attributes
    ----------
    channel : str
    plane_mm : float, mm
    kind : str
        The family of the pattern.
    gray : uint8 array [H, W]
    exposure_ms : float, ms
    why : str
        What it says, in words.
    expected_gain : float, nats
        Information that it adds to the captures that were chosen before it, or would add if it were fitted, too.
    """

    channel: str
    plane_mm: float
    kind: str
    gray: Gray
    exposure_ms: float
    why: str
    expected_gain: float

    def as_json(self, name: str, phase: str) -> dict[str, Any]:
        """A row of the key `captures` of `next --json`.

        Parameters
        ----------
        name : str
            Id of the capture, and of its pattern.
        phase : str
            Path of the pattern in the folder.
        """
        return {
            "capture": name,
            "channel": self.channel,
            "plane_mm": self.plane_mm,
            "pattern": name,
            "phase": phase,
            "exposure_ms": self.exposure_ms,
            "kind": self.kind,
            "why": self.why,
            "expected_gain": self.expected_gain,
        }


@dataclass(frozen=True)
class NextCaptures:
    """The captures to take, and what there is to decide.

    Attributes
    ----------
    chosen : tuple of NextCapture
        In the order in which they are to be taken, which decides which are held out.
    parameter_excess : float
        Excess that the errors of the model's numbers may make in a picture, in the worst of all possible captures
        with the usual exposure in the colours of the set.
    """

    chosen: tuple[NextCapture, ...]
    parameter_excess: float


def settled(doubts: Doubts, parameter_excess: float) -> bool:
    """Whether further captures have nothing to decide.

    The captures say what is missing or that nothing is, no other effect does as well, and the errors of the numbers
    make less than an effect must remove to be worth adding.
    """
    limit = doubts.diagnosis.thresholds.least(doubts.diagnosis.ideal_excess)
    return doubts.decided and parameter_excess < limit


def next_captures(
    captures: CaptureSet,
    doubts: Doubts,
    possible: Sequence[PossibleCapture],
    count: int,
    pool: Pool,
    progress: Progress | None = None,
) -> NextCaptures:
    """Choose captures by the information that they are expected to add.

    What counts is half the logarithm of the factor by which a capture shrinks the determinant of the covariance of the
    model's numbers (D-optimality), and half that of the growth of the information on each rival's share. Captures that
    will be held out say nothing to the fits, so they are chosen to be the lesser ones, and count as a price. A new
    colour and plane gets two patterns: the first is fitted, and without a second nothing judges there.

    Parameters
    ----------
    possible : sequence of PossibleCapture
        What to choose from.
    count : int
        How many to choose.
    progress : callable, optional
        Called with the share that is done and what is being done.

    Raises
    ------
    InputError
        Where none of them can be predicted.
    """
    report = progress or no_progress
    rivals = tuple(r.model for r in doubts.rivals)
    shared = (doubts.model, rivals, doubts.unexplained)
    report(0.0, "what the captures say")
    tasks = [(captures.folder, (c.capture,), *shared) for c in doubts.fitted]
    there = [i for found in pool.map(information_of_captures, tasks) for i in found]
    asked = [(captures.folder, p, *shared) for p in possible]
    what = f"predicting {len(asked)} possible captures"
    predicted = pool.map(information_of_possible, asked, lambda n: report(n / len(asked), what))
    if not any(predicted):
        planes = ", ".join(f"{z:g}" for z in sorted({p.plane_mm for p in possible}))
        raise InputError(f"the model does not reach the planes {planes} mm: give nearer --planes")
    state = _Information.of(doubts, there)
    patterns: dict[Scene, set[str]] = defaultdict(set)
    for c in captures.captures:
        patterns[c.channel, c.plane_mm].add(c.pattern)
    counts = {scene: len(names) for scene, names in patterns.items()}
    error = _parameter_excess(captures, state, possible, predicted)
    return NextCaptures(tuple(_greedy(state, possible, predicted, counts, count)), error)


@dataclass
class _Information:
    """What the captures so far say: of the model's numbers, and of each rival's numbers and share."""

    doubts: Doubts
    normal: np.ndarray
    scatter: np.ndarray
    rivals: list[np.ndarray]

    @classmethod
    def of(cls, doubts: Doubts, there: Sequence[ExpectedInformation]) -> _Information:
        """What a set's captures say."""
        rivals = []
        for rival in doubts.rivals:
            first = prior(rival.model)
            rivals.append(np.pad(first, (0, 1)))
            rivals[-1][-1, -1] = 1.0  # the share is somewhere from 0 to 1
        first = prior(doubts.model)
        state = cls(doubts, first, first, rivals)
        for one in there:
            state.add(one)
        return state

    def add(self, one: ExpectedInformation) -> None:
        self.normal = self.normal + one.normal
        self.scatter = self.scatter + one.scatter
        self.rivals = [a + b for a, b in zip(self.rivals, one.rivals, strict=True)]

    def gains(self, one: ExpectedInformation) -> tuple[float, list[float]]:
        """Nats that a capture adds: on the numbers, and on each rival's share."""
        more = _log_det(self.normal + one.normal) - _log_det(self.normal)
        numbers = more - 0.5 * (_log_det(self.scatter + one.scatter) - _log_det(self.scatter))
        shares = [
            0.5 * math.log(_of_share(a + b) / _of_share(a))
            for a, b in zip(self.rivals, one.rivals, strict=True)
        ]
        return numbers, shares

    def gain(self, one: ExpectedInformation) -> float:
        """Nats that a capture adds."""
        numbers, shares = self.gains(one)
        return numbers + sum(shares)

    def why(self, one: ExpectedInformation) -> str:
        """What a capture says most of, in words."""
        numbers, shares = self.gains(one)
        if shares and max(shares) >= min(numbers, 0.5):
            k = int(np.argmax(shares))
            words = f"tells {self.doubts.rivals[k]}: there they differ by {100 * one.difference[k] ** 0.5:.2g} % of "
            return words + "the signal's rms"
        keys = keys_of(self.doubts.model, self.doubts.model.names)
        if not keys:
            return "sharpens the brightness of the model"
        then = covariance(self.normal + one.normal, self.scatter + one.scatter)
        before, after = (
            np.sqrt(np.diag(c))[: len(keys)] for c in (covariance(self.normal, self.scatter), then)
        )
        k = int(np.argmin(after / before))
        effect, name, _ = keys[k]
        parameter = self.doubts.model.instance(effect).effect.parameter(name)
        unit = "" if parameter.unit in ("", "1") else f" {parameter.unit}"
        errors = [number(parameter.scale * float(e[k]), 2) for e in (before, after)]
        return f"sharpens {effect}: the error of {name.replace('_', ' ')} falls from {errors[0]} to {errors[1]}{unit}"


def _greedy(
    state: _Information,
    possible: Sequence[PossibleCapture],
    predicted: Sequence[Sequence[ExpectedInformation]],
    patterns: dict[Scene, int],
    count: int,
) -> list[NextCapture]:
    left = [k for k, one in enumerate(predicted) if one]
    found: list[NextCapture] = []
    patterns = dict(patterns)

    def best(keys: Sequence[int], rest: int) -> tuple[int, int]:
        """The capture, and its exposure, that says most for its price."""
        options = [
            (state.gain(one) / _price(patterns.get(possible[k].scene, 0), rest), k, e)
            for k in keys
            for e, one in enumerate(predicted[k])
            if one.saturated <= MOST_SATURATED or e == 0
        ]
        return max(options)[1:]

    def capture(k: int, e: int, judges: bool) -> NextCapture:
        one, information = possible[k], predicted[k][e]
        why = state.why(information) + ("; a second pattern there, to judge by" if judges else "")
        gain = float(state.gain(information))
        return NextCapture(one.channel, one.plane_mm, one.kind, one.gray, one.exposures_ms[e], why, gain)

    while left and len(found) < count:
        rest = count - len(found)
        k, e = best(left, rest)
        left.remove(k)
        scene = possible[k].scene
        place = patterns.get(scene, 0)
        pair = [capture(k, e, holds_out(place) and rest == 1)]
        state.add(predicted[k][e])
        others = [j for j in left if possible[j].scene == scene]
        if rest > 1 and others and _price(place, rest) == 2:
            j, f = best(others, rest)
            left.remove(j)
            # The better one goes where it is fitted.
            pair.insert(0 if holds_out(place) else 1, capture(j, f, True))
        found += pair
        patterns[scene] = place + len(pair)
    return found


def _price(place: int, rest: int) -> float:
    """How many captures it takes to have one more fitted in a colour and plane that has `place` patterns.

    Parameters
    ----------
    rest : int
        How many can be taken.
    """
    if place == 0:
        return 2  # the second is held out, and nothing judges there without it
    if not holds_out(place):
        return 1
    return 2 if rest > 1 else NEVER


def _parameter_excess(
    captures: CaptureSet,
    state: _Information,
    possible: Sequence[PossibleCapture],
    predicted: Sequence[Sequence[ExpectedInformation]],
) -> float:
    """Excess that the errors of the numbers may make in a picture, at worst."""
    spread = covariance(state.normal, state.scatter)
    excess = [
        float((spread * one[p.usual].excess).sum())
        for p, one in zip(possible, predicted, strict=True)
        if one and p.channel in captures.channels
    ]
    return max(excess, default=0.0)


def _log_det(matrix: np.ndarray) -> float:
    return float(np.linalg.slogdet(matrix)[1])


def _of_share(matrix: np.ndarray) -> float:
    """Information on the last number, the others left free."""
    along = np.linalg.solve(matrix[:-1, :-1], matrix[:-1, -1])
    return float(max(matrix[-1, -1] - matrix[:-1, -1] @ along, 1e-12))
