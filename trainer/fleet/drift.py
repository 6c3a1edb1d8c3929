"""Which effects drift together: rank correlations of fitted numbers over headsets, and over time in each headset.

*Over headsets* compares the headsets' means. *Over time* compares each set with the mean of its own headset, so that
what makes headsets differ plays no part (Bland and Altman 1995, parts 2 and 1). Correlations are Spearman's, which one
fit that went wrong does not decide; their intervals are those of Bonett and Wright 2000.

The errors of one fit hang together, too. Numbers of which error makes up a share of the variance show a correlation of
up to the root of the product of these shares without any drift. Two numbers count as drifting together where the
interval, corrected for the number of pairs that were tried, lies beyond that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from trainer.effects.effect_catalogue import Catalogue
from trainer.fleet.rank_correlation import Array, interval, spearman
from trainer.fleet.set_result import FittedNumber, SetResult

LEAST = 10  # headsets, or departures from headsets' means that are free to vary
VARIES = 2.0  # times its error: from here on a number's spread is more than its error
MOST_NUMBERS = 6  # of an effect, those that vary most; more pairs would only widen the intervals of all

ByHeadset = dict[str, list[tuple[str, float, float]]]  # folder, departure from the absent value, error
OVER = ("headsets", "time")


@dataclass(frozen=True)
class Departures:
    """How one number of an effect departs from its absent value, over headsets or over time.

    Attributes
    ----------
    number : FittedNumber
        What it is; its value is of no set in particular.
    over : str
        "headsets" or "time".
    labels : tuple
        Of each departure: the headset, or (headset, folder).
    values, errors : float64 array [n], in the number's unit
        Means of headsets, or departures from these means.
    free : int
        How many of the values are free to vary: over time, one mean for each headset is known.
    """

    number: FittedNumber
    over: str
    labels: tuple[Any, ...]
    values: Array
    errors: Array
    free: int

    @property
    def spread(self) -> float:
        """Standard deviation, in the number's unit."""
        away = self.values - (self.values.mean() if self.over == "headsets" else 0.0)
        free = self.free - (self.over == "headsets")
        return math.sqrt(float((away**2).sum()) / free) if free > 0 else 0.0

    @property
    def error(self) -> float:
        """Root mean square of the errors that are known, in the number's unit."""
        known = self.errors[np.isfinite(self.errors)]
        return math.sqrt(float((known**2).mean())) if known.size else 0.0

    @property
    def error_share(self) -> float:
        """Share of the variance that is the fits' errors, at most 1."""
        return min(1.0, (self.error / self.spread) ** 2) if self.spread > 0 else 1.0

    @property
    def varies(self) -> bool:
        """Whether there are enough values, and they differ by more than their errors."""
        return self.free >= LEAST and self.spread > max(VARIES * self.error, 1e-12)


@dataclass(frozen=True)
class DriftPair:
    """Two numbers of different effects, and how they vary together.

    Attributes
    ----------
    first, second : Departures
        Of the same headsets or sets, in the same order.
    correlation : float
        Spearman's.
    ci95 : (float, float)
        For this pair alone.
    by_error : float
        Size of a correlation that the fits' errors alone could make.
    together : bool
        Whether the interval, corrected for all pairs tried, lies beyond `by_error`.
    """

    first: Departures
    second: Departures
    correlation: float
    ci95: tuple[float, float]
    by_error: float
    together: bool

    @property
    def surely(self) -> float:
        """Size that the correlation has at least, by its interval; 0 where that holds 0."""
        low, high = self.ci95
        return max(low, -high, 0.0)

    @property
    def effects(self) -> tuple[str, str]:
        """Names of the two effects."""
        return self.first.number.effect, self.second.number.effect

    def as_json(self) -> dict[str, Any]:
        """Keys `first`, `second`, `correlation`, `ci95`, `by_error`, `count` and `together`."""
        return {
            "first": _named(self.first.number),
            "second": _named(self.second.number),
            "correlation": self.correlation,
            "ci95": list(self.ci95),
            "by_error": self.by_error,
            "count": len(self.first.values),
            "together": self.together,
        }


@dataclass(frozen=True)
class Drift:
    """What varies over headsets or over time, and what varies together.

    Attributes
    ----------
    over : str
        "headsets" or "time".
    count : int
        Headsets, or departures that are free to vary; below LEAST nothing is said.
    departures : tuple of Departures
        Of every number, those that vary most over their error first.
    pairs : tuple of DriftPair
        Of each two effects the two numbers that vary together most surely, the surest first.
    tried : int
        Pairs of numbers that were compared.
    """

    over: str
    count: int
    departures: tuple[Departures, ...]
    pairs: tuple[DriftPair, ...]
    tried: int

    @property
    def enough(self) -> bool:
        """Whether there are enough headsets, or sets of a headset, to say anything."""
        return self.count >= LEAST

    def as_json(self) -> dict[str, Any]:
        """Keys `count`, `needed`, `compared` and `pairs`."""
        return {
            "count": self.count,
            "needed": LEAST,
            "compared": self.tried,
            "pairs": [p.as_json() for p in self.pairs],
        }


def drift_of(results: Sequence[SetResult], over: str, known: Catalogue) -> Drift:
    """What varies, and what varies together, in the finished sets of a fleet.

    Parameters
    ----------
    over : str
        "headsets" or "time".
    known : Catalogue
        Says of which parameters the sign cannot be told; their sizes are compared.
    """
    done = [r for r in results if r.failed is None]
    numbers: dict[Any, FittedNumber] = {}
    away: dict[Any, ByHeadset] = {}
    for result in done:
        for number in result.numbers:
            numbers.setdefault(number.key, number)
            value = number.value - number.absent
            row = (result.facts.folder, abs(value) if _signless(number, known) else value, number.error)
            away.setdefault(number.key, {}).setdefault(result.facts.headset, []).append(row)
    every = [_departures(away[key], number, over) for key, number in numbers.items()]
    every.sort(key=lambda d: (not d.varies, d.error_share, d.number.effect))
    chosen: dict[str, list[Departures]] = {}
    for one in every:
        if one.varies and len(chosen.setdefault(one.number.effect, [])) < MOST_NUMBERS:
            chosen[one.number.effect].append(one)
    both = [
        shared
        for a, b in combinations(chosen, 2)
        for first in chosen[a]
        for second in chosen[b]
        if (shared := _shared(first, second, over)) is not None
    ]
    best: dict[tuple[str, str], DriftPair] = {}
    for first, second in both:
        pair = _pair(first, second, len(both))
        if pair.effects not in best or _rank(pair) < _rank(best[pair.effects]):
            best[pair.effects] = pair
    headsets = [r.facts.headset for r in done]
    count = len(set(headsets)) if over == "headsets" else _free(headsets)
    return Drift(over, count, tuple(every), tuple(sorted(best.values(), key=_rank)), len(both))


def _rank(pair: DriftPair) -> tuple[bool, float, float]:
    return not pair.together, -pair.surely, -abs(pair.correlation)


def _signless(number: FittedNumber, known: Catalogue) -> bool:
    """Whether captures cannot tell the number's sign, so that its size is compared."""
    effect = known.get(number.effect)
    return effect is not None and any(p.even for p in effect.parameters if p.name == number.parameter)


def _departures(by_headset: ByHeadset, number: FittedNumber, over: str) -> Departures:
    """Means of headsets, or departures from them, of one number."""
    labels: list[Any] = []
    values: list[float] = []
    errors: list[float] = []
    for headset, rows in by_headset.items():
        away = np.array([value for _, value, _ in rows])
        own = np.array([error for _, _, error in rows])
        if over == "headsets":
            labels.append(headset)
            values.append(float(away.mean()))
            errors.append(math.sqrt(float((own**2).sum())) / len(rows))
        elif len(rows) > 1:
            labels += [(headset, folder) for folder, _, _ in rows]
            values += list(away - away.mean())
            errors += list(own)
    free = len(values) if over == "headsets" else _free([headset for headset, _ in labels])
    return Departures(number, over, tuple(labels), np.array(values), np.array(errors), free)


def _free(headsets: Sequence[str]) -> int:
    """Departures from headsets' means that are free to vary, of sets of these headsets."""
    return len(headsets) - len(set(headsets))


def _shared(first: Departures, second: Departures, over: str) -> tuple[Departures, Departures] | None:
    """Both at the headsets or sets that have both, where these are enough and both vary there."""
    common = [label for label in first.labels if label in set(second.labels)]
    pair = tuple(_at(d, common, over) for d in (first, second))
    return (pair[0], pair[1]) if all(d.varies for d in pair) else None


def _at(one: Departures, labels: Sequence[Any], over: str) -> Departures:
    place = {label: k for k, label in enumerate(one.labels)}
    rows = [place[label] for label in labels]
    values, errors = one.values[rows], one.errors[rows]
    if over == "headsets":
        return Departures(one.number, over, tuple(labels), values, errors, len(rows))
    by_headset: ByHeadset = {}
    for (headset, folder), value, error in zip(labels, values, errors, strict=True):
        by_headset.setdefault(headset, []).append((folder, float(value), float(error)))
    return _departures(by_headset, one.number, over)


def _pair(first: Departures, second: Departures, tried: int) -> DriftPair:
    r = spearman(first.values, second.values)
    # Over time, as many as there would be of one headset.
    count = first.free + (first.over == "time")
    by_error = math.sqrt(first.error_share * second.error_share)
    low, high = interval(r, count, tried=tried)
    return DriftPair(
        first, second, r, interval(r, count), by_error, together=low > by_error or high < -by_error
    )


def _named(number: FittedNumber) -> dict[str, Any]:
    return {
        "effect": number.effect,
        "parameter": number.parameter,
        "channel": number.channel,
        "term": number.term,
        "unit": number.unit,
    }
