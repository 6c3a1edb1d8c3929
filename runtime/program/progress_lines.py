"""Progress as lines, where no bar can move: one now and then."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from threading import Lock

from firmware_iface.repeated import repeated

EVERY_S = 10.0  # seconds between two lines
EVERY_STEP_S = 1.0  # seconds between two lines of `--verbose` and `--log`, where steps are fast


class ProgressLines:
    """A progress callback that says how far the work is, in lines.

    Parameters
    ----------
    title : str
        What is said where the work does not say what it does.
    say : callable
        Takes each line.
    every_s : float, s
        Time between two lines; nothing is said of what takes less.
    each_step : bool
        A line also when something else is done than before.
    clock : callable
        Gives a time in seconds.
    """

    def __init__(
        self,
        title: str,
        say: Callable[[str], None],
        every_s: float = EVERY_S,
        each_step: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title, self._say, self._every_s, self._each_step, self._clock = (
            title,
            say,
            every_s,
            each_step,
            clock,
        )
        self._begin = self._last = clock()
        self._done = 0.0
        self._doing = self._what = ""  # what is done, and what the last line said of it
        self._lock = Lock()

    def __call__(self, done: float, what: str = "") -> None:
        """Say how far the work is, if it is time to."""
        with self._lock:
            self._done, self._doing = done, what or self._doing
            self._say_if_time()

    def going_on(self) -> AbstractContextManager[None]:
        """Say a line when it is time to also while the work itself says nothing, for as long as this lasts."""

        def watch() -> bool:
            with self._lock:
                self._say_if_time()
            return True

        return repeated(watch, self._every_s / 10)

    def _say_if_time(self) -> None:
        now, what = self._clock(), self._doing
        changed = (
            self._each_step and what != self._what and (not self._what or now - self._last >= EVERY_STEP_S)
        )
        if now - self._last < self._every_s and not changed:
            return
        self._last, self._what = now, what
        share = min(max(self._done, 0.0), 1.0)
        self._say(f"{100 * share:.0f} % {what or self._title} ({now - self._begin:.0f} s)")
