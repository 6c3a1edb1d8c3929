"""What a slow panel still shows, and what to send so that it shows the patterns that are wanted.

It follows what was really sent: the level that each pixel has reached at the end of a display time. Nothing is known of
a panel that was lost or has refused something, so the next pattern is sent to it as it is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.lightpath.overdrive import GRAYS, NEAREST, REACHED, STRAIGHT

Patterns = NDArray[np.uint8]

MOVING = 4  # display times after which patterns that stay count as a still picture
# A solver goes on with a still picture: of its patterns, fewer than a twentieth of the pixels change by so much.
STILL_LEVELS, STILL_SHARE = 8, 1 / 20
BLOCK = 1 << 16  # pixels
MOST_MISSED = 16  # display times that are followed one by one


class SlowPanel:
    """Overdrives the patterns of a slow panel.

    Parameters
    ----------
    tables : uint8 array [C, 3, 256, 256]
        Of each colour, `overdrive_tables`.
    passes : int
        How often the panel shows a frame in one display time. All passes show the same, so it is right for the last.

    Attributes
    ----------
    settled : bool
        Whether what is on the panel stays right for as long as it is there.
    """

    def __init__(self, tables: NDArray[np.uint8], passes: int = 1) -> None:
        self._passes = min(passes, 2)
        reached = tables[:, REACHED]
        self._after = reached.reshape(len(tables), -1)
        self._tables = {}
        for way in (NEAREST, STRAIGHT):
            sent = tables[:, way]
            then = np.take_along_axis(reached, sent.astype(np.intp), -1)
            self._tables[way] = sent.reshape(len(tables), -1), then.reshape(len(tables), -1)
        self.forget()

    def forget(self) -> None:
        """Nothing is known of the panel any more."""
        self.settled = True
        self._level: Patterns | None = None  # that each pixel has reached
        self._wanted: Patterns | None = None
        self._sent: Patterns | None = None
        self._at = 0
        self._shown = 0  # for how many display times about the same was wanted

    def driven(self, wanted: Patterns, at: int, straight: bool = False) -> Patterns:
        """The patterns to send so that the panel shows others.

        Parameters
        ----------
        wanted : uint8 array [C N, H, W]
            The fields of a frame.
        at : int
            Number of the display time.
        straight : bool
            Without whole waves, which a single pixel's light does not show: the panel ends at these patterns soonest.

        Returns
        -------
        uint8 array [C N, H, W]
        """
        still = self._wanted is not None and _about_the_same(wanted, self._wanted)
        self._shown = self._shown + 1 if still else 0
        if straight:
            self._shown = MOVING
        self._wanted, self.settled = wanted, False
        self._pass(at)
        self._sent = self._overdriven(wanted)
        return self._sent

    def again(self, at: int) -> Patterns | None:
        """The patterns to send where no others have come; None where they are on the panel already."""
        if self.settled or self._wanted is None or at <= self._at:
            return None
        self._shown += 1
        self._pass(at)
        level, before = self._level, self._sent
        self._sent = self._overdriven(self._wanted)
        assert level is not None and before is not None and self._level is not None
        if not np.array_equal(self._sent, before):
            return self._sent
        self.settled = self._shown >= MOVING and np.array_equal(self._level, level)
        return None

    def _pass(self, at: int) -> None:
        """Follow the panel through the display times before this one, in which nothing was sent."""
        missed, self._at = at - self._at - 1, at
        if self._level is None or self._sent is None:
            return
        for _ in range(min(missed, MOST_MISSED)):
            for k, sent in enumerate(self._sent):
                (self._level,) = _looked_up(self._level, sent, self._after[k % len(self._after)])

    def _overdriven(self, wanted: Patterns) -> Patterns:
        """What to send at the present level, which is then the one that is reached."""
        sent, reached = self._tables[STRAIGHT if self._shown >= MOVING else NEAREST]
        level = wanted[0] if self._level is None else self._level
        found = np.empty_like(wanted)
        for _ in range(self._passes):
            for k, gray in enumerate(wanted):
                found[k], level = _looked_up(level, gray, sent[k % len(sent)], reached[k % len(sent)])
        self._level = level
        return found


def slow_panel(tables: NDArray[np.uint8] | None, fields: int, passes: int) -> SlowPanel | None:
    """What overdrives a panel; None where it is not slow, or where one pattern stays for several periods and settles.

    Parameters
    ----------
    tables : uint8 array [C, 3, 256, 256] or None
        Of each colour, `overdrive_tables`.
    fields : int
        Of a frame.
    passes : int
        How often the panel shows it in one display time.
    """
    if tables is None or (fields == 1 and passes > 1):
        return None
    return SlowPanel(tables, passes)


def _about_the_same(one: Patterns, other: Patterns) -> bool:
    """Whether patterns are those of a still picture, on the circle of 256 levels."""
    changed = one - other + np.uint8(STILL_LEVELS) > 2 * STILL_LEVELS
    return bool(np.count_nonzero(changed) < STILL_SHARE * changed.size)


def _looked_up(before: Patterns, gray: Patterns, *tables: Patterns) -> list[Patterns]:
    """What each flat table has for the pairs [before, gray] of all pixels, in blocks that the cache holds."""
    found = [np.empty_like(gray) for _ in tables]
    first, second, flat = before.ravel(), gray.ravel(), [one.ravel() for one in found]
    for begin in range(0, gray.size, BLOCK):
        here = slice(begin, begin + BLOCK)
        pairs = first[here].astype(np.intp)
        pairs *= GRAYS
        pairs += second[here]
        for table, one in zip(tables, flat, strict=True):
            np.take(table, pairs, out=one[here], mode="clip")  # every pair is in the table
    return found
