"""How long work says how far it is: one kind of callback for all of hololoop."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """A callback that long work calls now and then."""

    def __call__(self, done: float, what: str = "") -> None:
        """Say how far the work is.

        Parameters
        ----------
        done : float
            Share of the work that is done, 0 to 1.
        what : str
            What is done now, for a person; empty: as before.
        """


def no_progress(done: float, what: str = "") -> None:
    """Shows nothing: the callback where nobody asks."""


def part_of(progress: Progress, begin: float, end: float, name: str = "") -> Progress:
    """The callback of one part of some work.

    Parameters
    ----------
    progress : Progress
        The whole work's callback.
    begin, end : float
        Shares of the whole work that are done when the part begins and ends.
    name : str
        What the part is; stands before what it says itself.
    """

    begun = False

    def part(done: float, what: str = "") -> None:
        nonlocal begun
        named = f"{name}: {what}" if name and what else what or name
        said = "" if begun and not what else named
        begun = True
        progress(begin + (end - begin) * done, said)

    return part


def forward_only(progress: Progress) -> Progress:
    """A callback that never goes back: work that came to nothing, and whose like begins again, was work, too."""
    farthest = 0.0

    def told(done: float, what: str = "") -> None:
        nonlocal farthest
        farthest = max(farthest, done)
        progress(farthest, what)

    return told
