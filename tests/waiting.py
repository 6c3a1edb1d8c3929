"""Waiting for what other threads and processes do."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def until(condition: Callable[[], T], within_s: float = 5.0) -> T:
    """The condition's value as soon as it is true; it fails where that takes longer."""
    end = time.monotonic() + within_s
    while not (found := condition()):
        assert time.monotonic() < end, f"it did not happen within {within_s:g} s"
        time.sleep(0.005)
    return found
