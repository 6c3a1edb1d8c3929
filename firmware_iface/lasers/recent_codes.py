"""The DAC's codes of the last moments: the light that a photodiode may still hold where a panel gates its laser."""

from __future__ import annotations

from collections import deque

REMEMBERED = 40  # changes; a ramp makes 20


class RecentCodes:
    """Codes of each laser, as they changed.

    Parameters
    ----------
    lasers : int
        How many there are.
    held_s : float, s
        How long a photodiode may hold an older light; 0: it shows the present one.

    Attributes
    ----------
    now : list of int
        The code of each laser.
    """

    def __init__(self, lasers: int, held_s: float) -> None:
        self.now = [0] * lasers
        self._held_s = held_s
        self._changes: list[deque[tuple[float, int]]] = [deque(maxlen=REMEMBERED) for _ in range(lasers)]

    def put(self, laser: int, code: int, at_s: float) -> None:
        """Note a laser's new code."""
        self._changes[laser].append((at_s, self.now[laser]))
        self.now[laser] = code

    def bounds(self, laser: int, at_s: float) -> tuple[int, int]:
        """The lowest and the highest code whose light a laser's photodiode may show."""
        since_s = at_s - self._held_s
        held = [code for until_s, code in self._changes[laser] if self._held_s and until_s > since_s]
        return min([self.now[laser], *held]), max([self.now[laser], *held])
