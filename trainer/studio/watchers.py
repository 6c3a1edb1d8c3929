"""Who hears of changes of the project: one watcher for each browser."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

Watcher = Callable[[str], None]


class Watchers:
    """Functions that are called, in any thread, with the topic of each change."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._functions: dict[int, Watcher] = {}

    def add(self, watcher: Watcher) -> int:
        """Have a function called with the topic of each change; returns a number for `remove`."""
        with self._lock:
            number = max(self._functions, default=0) + 1
            self._functions[number] = watcher
            return number

    def remove(self, number: int) -> None:
        """Call a function no longer."""
        with self._lock:
            self._functions.pop(number, None)

    def tell(self, *topics: str) -> None:
        """Say that something has changed."""
        with self._lock:
            functions = list(self._functions.values())
        for topic in topics:
            for function in functions:
                with suppress(Exception):  # a browser that has just left
                    function(topic)
