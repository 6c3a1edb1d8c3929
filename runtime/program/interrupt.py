"""Ctrl-C: what is left of the work, and steps that are not cut in two."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with a sentence on what is left of the work."""


@contextmanager
def ctrl_c_waits() -> Iterator[None]:
    """Let Ctrl-C within the block take effect at its end, so that what is done there is done whole.

    Raises
    ------
    KeyboardInterrupt
        At the end of the block, where Ctrl-C was pressed within it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: signals.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if signals:
        raise KeyboardInterrupt
