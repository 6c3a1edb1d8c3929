"""How a shape's strength changes over the captures: evenly, settling, or swinging, by their order or by their time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trainer.captures.capture_table import Moment
from trainer.diagnosis.proposals.reading import Array, Number, Reading
from trainer.formatting import number

LEAST_CAPTURES = 6
EXPLAINED = 0.8  # of the strengths' scatter over the captures: what a curve must explain
SAME_PACE = 0.999  # correlation of time and order from which they tell the same


@dataclass(frozen=True)
class Clock:
    """What the strengths are a function of.

    Attributes
    ----------
    name : str
        An attribute of `Moment`.
    unit : str
    about : str
    """

    name: str
    unit: str
    about: str

    def of(self, moments: Sequence[Moment]) -> Array:
        """The clock at some moments."""
        return np.array([getattr(m, self.name) for m in moments], dtype=float)


ORDER = Clock("number", "captures", "captures taken before this one")
TIME = Clock("time_s", "s", "from the first capture")


def clock_of(moments: Sequence[Moment]) -> Clock:
    """The captures' order, or their time where they were not taken at an even pace."""
    order, time = ORDER.of(moments), TIME.of(moments)
    if np.ptp(time) == 0 or np.ptp(order) == 0:
        return ORDER
    return ORDER if np.corrcoef(order, time)[0, 1] > SAME_PACE else TIME


@dataclass(frozen=True)
class Strengths:
    """How strong a shape is in each capture.

    Attributes
    ----------
    moments : tuple of Moment
    values : array [captures]
        1 where the shape is as it was read.
    weights : array [captures]
        Inverse variances of the values, up to a factor.
    """

    moments: tuple[Moment, ...]
    values: Array
    weights: Array


def curves_in(seen: Strengths) -> list[tuple[float, Reading]]:
    """Curves over the captures that explain how a shape's strength changes, the best first.

    Returns
    -------
    list of (float, Reading)
        The size of the shape where the curve is 1, and the curve; `explained` is its share of the scatter. None where
        the strengths are one number, or have no such curve.
    """
    clock = clock_of(seen.moments)
    t = clock.of(seen.moments)
    if len(t) < LEAST_CAPTURES or np.ptp(t) == 0:
        return []
    found = [c for c in (_line(clock, t, seen), _settling(clock, t, seen), _swing(clock, t, seen)) if c]
    kept = [(size, r) for size, r in found if r.explained > EXPLAINED and math.isfinite(size) and size]
    # A curve of more numbers explains more by chance.
    return sorted(kept, key=lambda one: (1 - one[1].explained) / (len(t) - 2 - len(one[1].numbers)))


def _line(clock: Clock, t: Array, seen: Strengths) -> tuple[float, Reading] | None:
    (level, slope), fitted = _least_squares(seen, np.ones_like(t), t)
    ends = (float(t.min()), float(t.max()))
    at = max(ends, key=lambda end: abs(level + slope * end))
    size = level + slope * at
    if size == 0:
        return None
    last = at == ends[1]
    return size, Reading(
        name="line",
        about="It changes evenly from capture to capture.",
        describe=lambda v: (
            f"a strength that changes by {number(100 * float(v['slope']) * (ends[1] - ends[0]))} % from the first "
            f"capture to the last, of the {'last' if last else 'first'} one's"
        ),
        formula=rf"v = 1 + s\,(t - {at:.6g})",
        numbers=(
            Number(
                "slope",
                "1",
                _rounded(0.05 / (ends[1] - ends[0])),
                slope / size,
                0.0,
                -10.0,
                10.0,
                f"relative change for each of the {clock.unit}",
            ),
        ),
        code=(
            f"    t = moment.{clock.name}  # {clock.about}",
            f"    value = 1 + slope * (t - {at:.6g})",
        ),
        found=fitted / size,
        explained=_explained(seen, fitted),
        whole=True,
    )


def _settling(clock: Clock, t: Array, seen: Strengths) -> tuple[float, Reading] | None:
    span = float(np.ptp(t))
    tried = []
    for constant in np.geomspace(span / 20, 1.5 * span, 60):
        (rest, size), fitted = _least_squares(seen, np.ones_like(t), np.exp(-t / constant))
        tried.append((_explained(seen, fitted), float(constant), rest, size, fitted))
    explained, constant, rest, size, fitted = max(tried, key=lambda one: one[0])
    if size == 0:
        return None
    return size, Reading(
        name="settling",
        about="It settles from capture to capture.",
        describe=lambda v: (
            f"a strength that settles within {number(float(v['settling']))} {clock.unit}, to "
            f"{number(float(v['rest']))} from {number(1 + float(v['rest']))}"
        ),
        formula=r"v = r + e^{-t/\tau}",
        numbers=(
            Number(
                "settling",
                clock.unit,
                _rounded(0.1 * constant),
                constant,
                _rounded(constant),
                constant / 10,
                constant * 10,
                "until a part of 1/e is left",
            ),
            Number("rest", "1", 0.05, rest / size, 0.0, -100.0, 100.0, "strength in the end"),
        ),
        code=(
            f"    t = moment.{clock.name}  # {clock.about}",
            "    value = rest + torch.exp(-t / settling)",
        ),
        found=fitted / size,
        explained=explained,
        whole=True,
    )


def _swing(clock: Clock, t: Array, seen: Strengths) -> tuple[float, Reading] | None:
    span = float(np.ptp(t))
    pace = span / max(1, len(t) - 1)
    tried = []
    for frequency in np.arange(0.6 / span, 0.5 / pace, 0.02 / span):
        angle = 2 * math.pi * frequency * t
        terms, fitted = _least_squares(seen, np.ones_like(t), np.cos(angle), np.sin(angle))
        tried.append((_explained(seen, fitted), float(frequency), terms, fitted))
    if not tried:
        return None
    explained, frequency, (rest, cosine, sine), fitted = max(tried, key=lambda one: one[0])
    size, begin = math.hypot(cosine, sine), math.degrees(math.atan2(-sine, cosine))
    if size == 0:
        return None
    period = 1 / frequency
    return size, Reading(
        name="swing",
        about="It swings from capture to capture.",
        describe=lambda v: (
            f"a strength that swings with a period of {number(float(v['swing']))} {clock.unit} by 1 about "
            f"{number(float(v['rest']))}"
        ),
        formula=r"v = r + \cos\left(\frac{2\pi t}{p} + \beta\right)",
        numbers=(
            Number(
                "swing",
                clock.unit,
                _rounded(0.03 * period**2 / span),
                period,
                _rounded(period),
                period / 2,
                period * 2,
                "period",
            ),
            Number(
                "begin", "deg", 3.0, begin, 0.0, -400.0, 400.0, "where the swing stands at the first capture"
            ),
            Number("rest", "1", 0.05, rest / size, 0.0, -100.0, 100.0, "strength about which it swings"),
        ),
        code=(
            f"    t = moment.{clock.name}  # {clock.about}",
            "    value = rest + torch.cos(2 * math.pi * t / swing + begin * (math.pi / 180))",
        ),
        found=fitted / size,
        explained=explained,
        whole=True,
    )


def _least_squares(seen: Strengths, *basis: Array) -> tuple[list[float], Array]:
    """Terms of a weighted least-squares fit of the strengths, and the fit."""
    table = np.stack(basis, axis=1)
    root = np.sqrt(seen.weights)
    terms = np.linalg.lstsq(table * root[:, None], seen.values * root, rcond=None)[0]
    return [float(term) for term in terms], table @ terms


def _explained(seen: Strengths, fitted: Array) -> float:
    """Share of the strengths' scatter about their mean."""
    mean = float((seen.weights * seen.values).sum() / seen.weights.sum())
    before = float((seen.weights * (seen.values - mean) ** 2).sum())
    return 1 - float((seen.weights * (seen.values - fitted) ** 2).sum()) / before if before > 0 else 0.0


def _rounded(value: float) -> float:
    """A number with two significant digits, for a file that people read."""
    return float(f"{value:.2g}")
