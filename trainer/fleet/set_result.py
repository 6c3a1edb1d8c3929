"""What a fleet run knows of one capture set: facts, what was found, and the fitted numbers."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class FittedNumber:
    """One number of a parameter of an effect in the model of a set.

    Attributes
    ----------
    effect, stage, parameter : str
        The parameter without its unit.
    channel : str or None
        Where the parameter has a value for each colour.
    term : int or None
        From 1, where the parameter is a map or a curve of several numbers.
    term_name : str or None
        The term for people, where it has a name.
    value, error, absent : float, in `unit`
        The error is NaN where nothing was fitted; `absent` is the value at which the effect is not there.
    unit : str
        "1" for a pure number.
    """

    effect: str
    stage: str
    parameter: str
    channel: str | None
    term: int | None
    term_name: str | None
    value: float
    error: float
    absent: float
    unit: str

    @property
    def key(self) -> tuple[str, str, str | None, int | None]:
        """What it has in common with the same number of other sets."""
        return self.effect, self.parameter, self.channel, self.term


@dataclass(frozen=True)
class SetFacts:
    """What a capture set's tables say, without its pictures.

    Attributes
    ----------
    folder : str
        Absolute.
    headset, headset_from : str
        Its name, and where that is from: "bench.toml" or "folder".
    time : datetime or None
        Of the captures, UTC; None where the folder cannot be read.
    time_from : str or None
        "captures.csv" or "file".
    stamp : str
        SHA-256, hex, of the names, sizes and times of the set's files and of the model that it starts from; "" where
        they cannot be read.
    """

    folder: str
    headset: str
    headset_from: str
    time: datetime | None = None
    time_from: str | None = None
    stamp: str = ""


@dataclass(frozen=True)
class SetResult:
    """One set of a fleet run, finished or failed.

    Attributes
    ----------
    facts : SetFacts
    failed : str or None
        What failed, in one sentence; None where the set is finished.
    model : str or None
        The file that was started from; None: the ideal model.
    verdict : str or None
        "complete", "missing" or "outside_catalogue"; of a recalibration "complete" or "incomplete".
    excess_before, excess_after, noise_nrmse : float or None
        On held-out captures.
    indistinguishable : dict
        By effect: those that the captures cannot tell it from.
    numbers : tuple of FittedNumber
    warnings : tuple of str
    captures_sha256 : str or None
    captures : int
    seconds : float, s
        That the work took.
    """

    facts: SetFacts
    failed: str | None = None
    model: str | None = None
    verdict: str | None = None
    excess_before: float | None = None
    excess_after: float | None = None
    noise_nrmse: float | None = None
    indistinguishable: tuple[tuple[str, str], ...] = ()
    numbers: tuple[FittedNumber, ...] = ()
    warnings: tuple[str, ...] = ()
    captures_sha256: str | None = None
    captures: int = 0
    seconds: float = 0.0

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects in its model, of those that have numbers."""
        return tuple(dict.fromkeys(n.effect for n in self.numbers))
