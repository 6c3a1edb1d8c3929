"""What a shape reads off a probe's map: its numbers, where their fit starts, and how a file computes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trainer.formatting import number

Array = NDArray[np.float64]
Values = Mapping[str, Any]


@dataclass(frozen=True)
class Number:
    """A parameter of a proposed effect.

    Attributes
    ----------
    name, unit : str
    scale : float
        A small but visible change.
    start : float or tuple of float
        What the probe's map shows; a tuple for a parameter of several numbers.
    absent : float
        Value at which the effect is not there, or any where another parameter says that.
    low, high : float
        Physical range.
    about : str
    grows : bool
        It is part of the shape's size: its distance from `absent` grows with it.
    """

    name: str
    unit: str
    scale: float
    start: float | tuple[float, ...]
    absent: float = 0.0
    low: float = -10.0
    high: float = 10.0
    about: str = ""
    grows: bool = False

    @property
    def size(self) -> int:
        """How many numbers it is."""
        return len(self.start) if isinstance(self.start, tuple) else 1

    def scaled(self, factor: float) -> Number:
        """The number as a shape of another size has it."""
        if not self.grows:
            return self
        if isinstance(self.start, tuple):
            return replace(self, start=tuple(self.absent + factor * (v - self.absent) for v in self.start))
        return replace(self, start=self.absent + factor * (self.start - self.absent))


@dataclass(frozen=True)
class Reading:
    """A shape found in a map.

    Attributes
    ----------
    name : str
        Of the shape: the end of the effect's name.
    about : str
        One line on the shape.
    describe : callable
        `{parameter: value} -> words` that say how large it is, and where.
    formula : str
        LaTeX of `value`.
    numbers : tuple of Number
    code : tuple of str
        Lines that compute the tensor `value` from the parameters and the coordinates `y` and `x` (or `level`).
    found : array
        The shape on the map's nodes.
    explained : float
        Share of the map's variance.
    imports : tuple of str
        Lines that `code` needs beyond torch.
    whole : bool
        As a factor it is the other shape's whole strength; otherwise its relative change.
    """

    name: str
    about: str
    describe: Callable[[Values], str]
    formula: str
    numbers: tuple[Number, ...]
    code: tuple[str, ...]
    found: Array
    explained: float
    imports: tuple[str, ...] = ()
    whole: bool = False

    @property
    def starts(self) -> dict[str, Any]:
        """What was read, by parameter: where a fit starts."""
        return {n.name: np.asarray(n.start) for n in self.numbers}

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return sum(n.size for n in self.numbers)

    def scaled(self, factor: float) -> Reading:
        """The shape at another size."""
        return replace(self, numbers=tuple(n.scaled(factor) for n in self.numbers), found=factor * self.found)


def with_unit(value: float, unit: str) -> str:
    """A number with its unit, as a sentence has it."""
    return number(value) if unit == "1" else f"{number(value)} {unit}"


def rms(values: Any) -> float:
    """Standard deviation of some numbers."""
    return float(np.std(np.asarray(values)))


def share_explained(values: Array, found: Array) -> float:
    """Share of a map's variance that a shape explains; real or complex."""
    total = float((np.abs(values - values.mean()) ** 2).sum())
    left = values - found
    return 1 - float((np.abs(left - left.mean()) ** 2).sum()) / total if total > 0 else 0.0
