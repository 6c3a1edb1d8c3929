"""The deadline of a solve: whether another iteration still fits before it, from how long the last ones took."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from firmware_iface.errors import InputError

REMEMBERED = 8  # durations
SPARE = 1.05  # of the slowest duration: a little is kept for what was not measured yet


class Pace:
    """How long a piece of work takes that is done again and again, in milliseconds."""

    def __init__(self) -> None:
        self._durations: deque[float] = deque(maxlen=REMEMBERED)

    def took(self, milliseconds: float) -> None:
        """Remember one more duration."""
        self._durations.append(milliseconds)

    def skipped(self) -> None:
        """Forget the slowest duration, if others are known: the work was left out, as it was expected to take too long.

        What is left out is not measured, so one slow time would keep it from being done for ever.
        """
        if len(self._durations) > 1:
            self._durations.remove(max(self._durations))

    @property
    def known(self) -> bool:
        """Whether it was ever measured."""
        return bool(self._durations)

    @property
    def expected(self) -> float:
        """What to plan with: the slowest of the remembered durations, and a little more."""
        return SPARE * max(self._durations, default=0.0)

    @property
    def usual(self) -> float:
        """The median of the remembered durations."""
        return sorted(self._durations)[len(self._durations) // 2] if self._durations else 0.0


@dataclass(frozen=True)
class Paces:
    """How long the parts of a solve take: from the target to the first light, an iteration, rounding to gray levels."""

    start: Pace = field(default_factory=Pace)
    iteration: Pace = field(default_factory=Pace)
    rounding: Pace = field(default_factory=Pace)


@dataclass(frozen=True)
class Deadline:
    """When a solve has to be done, and the rule that stops it in time.

    Attributes
    ----------
    milliseconds : float or None, ms
        From the target to the gray levels; None: no deadline.
    paces : Paces
        Of its parts.
    """

    milliseconds: float | None
    paces: Paces

    def allows_another(self, spent: float) -> bool:
        """Whether another iteration and the rounding are expected to end in time, after `spent` ms."""
        if self.milliseconds is None:
            return True
        return spent + self.paces.iteration.expected + self.paces.rounding.expected <= self.milliseconds


def check_deadline(milliseconds: float | None) -> None:
    """Raise InputError for a deadline (ms) that is not above 0."""
    if milliseconds is not None and not (math.isfinite(milliseconds) and milliseconds > 0):
        raise InputError(f"a deadline of {milliseconds} ms: give milliseconds above 0")
