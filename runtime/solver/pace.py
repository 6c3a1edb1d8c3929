"""How long a piece of work will take, from how long it took lately."""

from __future__ import annotations

from collections import deque

REMEMBERED = 8  # times
SPARE = 1.05  # a little is kept for what was not seen yet


class Pace:
    """Milliseconds of something that is done again and again."""

    def __init__(self) -> None:
        self._lately: deque[float] = deque(maxlen=REMEMBERED)

    def took(self, milliseconds: float) -> None:
        """Keep it up to date."""
        self._lately.append(milliseconds)

    @property
    def known(self) -> bool:
        """Whether it was ever measured."""
        return bool(self._lately)

    @property
    def expected(self) -> float:
        """What to reckon with: the slowest of late, and a little more."""
        return SPARE * max(self._lately, default=0.0)

    @property
    def usual(self) -> float:
        """The median of late."""
        return sorted(self._lately)[len(self._lately) // 2] if self._lately else 0.0
