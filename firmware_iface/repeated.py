"""Work that repeats in a thread of its own while a program does something else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread


@contextmanager
def repeated(act: Callable[[], bool], every_s: float) -> Iterator[None]:
    """Call a function again and again during a block, from a thread that ends with it.

    Parameters
    ----------
    act : callable
        Returns whether to go on.
    every_s : float, s
        Time between two calls, and before the first.
    """
    ended = Event()

    def run() -> None:
        while not ended.wait(every_s) and act():
            pass

    thread = Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
