"""A fleet's findings in words: what drifts together, and how a number of an effect is called."""

from __future__ import annotations

from collections.abc import Sequence

from trainer.fleet.drift import LEAST, Drift, DriftPair
from trainer.fleet.set_result import FittedNumber, SetResult
from trainer.formatting import UNITLESS, listed, plain


def label(one: FittedNumber) -> str:
    """The effect's and the number's name with the unit, for axes and tables."""
    parts = [] if one.parameter == one.effect else [plain(one.parameter)]
    if one.term is not None:
        parts.append(one.term_name or f"term {one.term}")
    if one.channel is not None:
        parts.append(one.channel)
    unit = "" if one.unit in UNITLESS else f" / {one.unit}"
    return plain(one.effect) + (f": {', '.join(parts)}" if parts else "") + unit


def drift_sentence(drift: Drift) -> str:
    """What drifts together over headsets or over time, in one or two sentences."""
    where = "over headsets" if drift.over == "headsets" else "over time"
    if not drift.enough:
        return f"{where.capitalize()} there is too little to say what drifts together: {_lacking(drift)}."
    if not drift.tried:
        varying = sum(d.varies for d in drift.departures)
        few = "no number varies" if not varying else "numbers of one effect alone vary"
        return f"{where.capitalize()} {few} by more than the fits' errors."
    together = [p for p in drift.pairs if p.together]
    if not together:
        return f"{where.capitalize()} no two effects drift together beyond chance."
    named = [f"{plain(p.effects[0])} and {plain(p.effects[1])} ({correlation_text(p)})" for p in together[:3]]
    more = f", and {len(together) - 3} more pairs" if len(together) > 3 else ""
    return f"{where.capitalize()} these drift together: {'; '.join(named)}{more}."


def correlation_text(pair: DriftPair) -> str:
    """A correlation with its interval."""
    low, high = map(two_places, pair.ci95)
    return f"rank correlation {two_places(pair.correlation)}, 95 % interval {low} to {high}"


def two_places(value: float) -> str:
    """A correlation as text."""
    return f"{value:.2f}".replace("-", "−")


def _lacking(drift: Drift) -> str:
    if drift.over == "headsets":
        return f"{drift.count} headset{'s' * (drift.count != 1)}, and it takes {LEAST}"
    return f"{drift.count} sets beyond the first of each headset, and it takes {LEAST}"


def one_name(results: Sequence[SetResult]) -> str:
    """What to change where all sets seem to be of one headset; "" where they are of several."""
    names = [r.facts.headset for r in results if r.failed is None]
    if len(names) < 2 or len(set(names)) > 1:
        return ""
    return (
        f"All sets have the name {names[0]!r}, so they count as one headset at several times: if they are of several, "
        "give each bench.toml a name of its own."
    )


def doubts(results: Sequence[SetResult], task: str) -> list[str]:
    """What a reader must know before believing the page."""
    done = [r for r in results if r.failed is None]
    same = one_name(results)
    said = [same] if same else []
    left = sum(r.verdict != "complete" for r in done)
    if left:
        where = "explain them" if task == "recalibrate" else "see their verdicts"
        said.append(
            f"{left} of {len(done)} finished sets are not complete: something is missing in their models, so the sizes "
            f"of what is there may be off, and may seem to drift together ({where})."
        )
    by_file = sum(r.facts.time_from == "file" for r in done)
    if by_file:
        said.append(
            f"The time of {by_file} of {len(done)} sets is that of their first picture's file, which copying may "
            "change; a column taken_at in captures.csv says it for good."
        )
    alike = sorted({name for r in done for name, _ in r.indistinguishable})
    if alike:
        said.append(
            f"In some sets the captures cannot tell {listed(plain(a) for a in alike)} from another effect, and either "
            "may have been taken for the other."
        )
    return said
