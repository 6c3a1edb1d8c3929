"""The service's loop: sockets that are readable, and work that other threads hand over."""

from __future__ import annotations

import os
import selectors
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol


class Readable(Protocol):
    """Anything with a descriptor."""

    def fileno(self) -> int:
        """Its number."""


class Loop:
    """Calls who is told that something came; everything in it happens in one thread."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._woken = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._work: deque[Callable[[], None]] = deque()
        self.watch(os.fdopen(self._woken, "rb", buffering=0), self._wake)

    def watch(self, what: Readable, read: Callable[[], None]) -> None:
        """Call `read` whenever there is something to read."""
        self._selector.register(what, selectors.EVENT_READ, read)

    def forget(self, what: Readable) -> None:
        """Watch it no more; before it is closed."""
        with suppress(KeyError, ValueError):
            self._selector.unregister(what)

    def later(self, do: Callable[[], None]) -> None:
        """Have something done by the loop; from any thread and from signal handlers."""
        self._work.append(do)
        with suppress(BlockingIOError):
            os.eventfd_write(self._woken, 1)

    def turn(self, wait_s: float) -> None:
        """Do what there is to do; wait so long for something."""
        for key, _ in self._selector.select(wait_s):
            key.data()

    def close(self) -> None:
        """Watch nothing more."""
        self._selector.close()

    def _wake(self) -> None:
        os.eventfd_read(self._woken)
        while self._work:
            self._work.popleft()()
