"""Files that other programs may change: the command line, or an editor."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

EVERY_S = 0.7  # between two looks


class WatchedFiles:
    """Looks at files again and again, in a thread of its own.

    Parameters
    ----------
    lock : RLock
        Held while a look is compared with the one before, and by whoever writes the files and calls `seen`.
    files : callable
        The files that are to be watched now.
    changed : callable
        Called with those that have changed since the last look.
    """

    def __init__(
        self, lock: Any, files: Callable[[], Iterable[Path]], changed: Callable[[list[Path]], None]
    ) -> None:
        self._lock, self._files, self._changed = lock, files, changed
        self._marks: dict[Path, int] = {}
        self._closing = threading.Event()
        threading.Thread(target=self._look, daemon=True).start()

    def seen(self) -> None:
        """Take the files as they are now: this program has changed them, or begins to watch them."""
        self._marks = {path: _time_of(path) for path in self._files()}

    def close(self) -> None:
        """Look no more."""
        self._closing.set()

    def _look(self) -> None:
        while not self._closing.wait(EVERY_S):
            with suppress(Exception):  # a file that goes away while it is looked at
                with self._lock:
                    found = [p for p in self._files() if _time_of(p) != self._marks.get(p)]
                    if found:
                        self.seen()
                if found:
                    self._changed(found)


def _time_of(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
