"""The service's event loop: sockets that are readable, and work from other threads."""

from __future__ import annotations

import os
import selectors
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol


class Readable(Protocol):
    """Anything with a file descriptor."""

    def fileno(self) -> int:
        """The descriptor."""


class EventLoop:
    """Calls a function when its descriptor is readable. All calls are made in one thread."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._woken = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._work: deque[Callable[[], None]] = deque()
        self.watch(os.fdopen(self._woken, "rb", buffering=0), self._wake)

    def watch(self, what: Readable, read: Callable[[], None]) -> None:
        """Call `read` whenever there is something to read."""
        self._selector.register(what, selectors.EVENT_READ, read)

    def forget(self, what: Readable) -> None:
        """Stop watching it; call this before it is closed."""
        with suppress(KeyError, ValueError):
            self._selector.unregister(what)

    def later(self, do: Callable[[], None]) -> None:
        """Call `do` in the loop's thread; for any thread and for signal handlers."""
        self._work.append(do)
        with suppress(BlockingIOError):
            os.eventfd_write(self._woken, 1)

    def turn(self, wait_s: float) -> None:
        """Make the calls that are due; wait at most `wait_s` for the first."""
        for key, _ in self._selector.select(wait_s):
            key.data()

    def close(self) -> None:
        """Stop watching everything."""
        self._selector.close()

    def _wake(self) -> None:
        os.eventfd_read(self._woken)
        while self._work:
            self._work.popleft()()
