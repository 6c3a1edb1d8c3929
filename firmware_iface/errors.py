"""The project's errors: bad input, and devices that fail."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Input that cannot be used: one sentence that says what is wrong, where, and what to change."""


def nearest(word: str, known: Iterable[str]) -> str:
    """A hint that names the known word nearest to `word`, or lists all known words when none is near.

    Parameters
    ----------
    word : str
        As it was written.
    known : iterable of str
        What could have been written.

    Returns
    -------
    str
    """
    names = list(known)
    close = difflib.get_close_matches(str(word), names, n=1, cutoff=0.5)
    if close:
        return f"did you mean '{close[0]}'?"
    return "known are " + ", ".join(names)


class DeviceError(RuntimeError):
    """A device failed: one sentence that says which, what happened, and what to do."""


class DeviceGoneError(DeviceError):
    """The device is not attached, or not any more; it may come back."""
