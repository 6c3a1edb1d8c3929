"""The page of a fleet: what drifts together, what varies, which sets failed, and every set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trainer.fleet.drift import LEAST, VARIES, Departures, Drift
from trainer.fleet.drift_charts import effects_chart, pair_chart, pairs_chart, time_chart
from trainer.fleet.fleet_words import correlation_text, doubts, drift_sentence, label, two_places
from trainer.fleet.rank_correlation import CONFIDENCE
from trainer.fleet.set_result import SetResult
from trainer.formatting import number, percent, plain
from trainer.report.html_report import report_style, write_page

MOST_PAIRS = 12  # in a chart
MOST_SHOWN = 3  # pairs drawn point by point
MOST_VARYING = 24  # numbers in the table

METHOD = (
    "A departure is a fitted number less the value at which its effect is not there, in the sets whose model has the "
    "effect. Over headsets, each headset's mean is one point; over time, each set is compared with its own headset's "
    "mean. Of parameters whose sign no capture can tell, the size is taken.",
    f"Correlations are Spearman's, with {100 * CONFIDENCE:.0f} % intervals after Bonett and Wright (2000); nothing is "
    f"said of fewer than {LEAST} headsets, or {LEAST} sets beyond the first of each headset. Only numbers that spread "
    f"by more than {VARIES:g} times their fits' error are compared, and of each two effects the pair that is surest is "
    "shown.",
    "Two effects drift together where the interval, corrected for all pairs of numbers that were tried, lies beyond "
    "the correlation that the fits' errors alone could make (the broad bar). That they do says nothing of the cause: "
    "a third thing, such as temperature, may move both.",
)
VERDICTS = {"complete": "good", "missing": "warn", "incomplete": "warn", "outside_catalogue": "bad"}


def write_page_of_fleet(
    path: Path, name: str, results: Sequence[SetResult], drifts: Sequence[Drift], task: str
) -> None:
    """Write the page; the file appears whole or not at all.

    Parameters
    ----------
    name : str
        Of the table.
    drifts : sequence of Drift
        Over headsets, and over time.
    task : str
        "explain" or "recalibrate".
    """
    done = [r for r in results if r.failed is None]
    times = {r.facts.folder: r.facts.time for r in done}
    context = {
        "title": f"Fleet: {name}",
        "style": report_style(),
        "sentences": [drift_sentence(d) for d in drifts],
        "tone": "warn" if any(p.together for d in drifts for p in d.pairs) else "plain",
        "facts": _facts(results, task),
        "doubts": doubts(results, task),
        "drifts": [_drift(d, times) for d in drifts],
        "effects": _effects(done),
        "varying": _varying(drifts),
        "failed": [r for r in results if r.failed],
        "sets": [_set(r) for r in results],
        "method": METHOD,
    }
    write_page(path, "trainer.fleet", "fleet.html", context)


def _facts(results: Sequence[SetResult], task: str) -> list[tuple[str, str, str]]:
    done = [r for r in results if r.failed is None]
    verdicts = Counter(r.verdict for r in done)
    days = sorted(r.facts.time for r in done if r.facts.time is not None)
    before, after = (
        _median([e for r in done if (e := getattr(r, name)) is not None])
        for name in ("excess_before", "excess_after")
    )
    verb = "explained" if task == "explain" else "recalibrated"
    failed = len(results) - len(done)
    rows = [
        (f"sets {verb}", str(len(done)), f"{failed} failed" if failed else "none failed"),
        ("headsets", str(len({r.facts.headset for r in done})), "by the name in bench.toml"),
        ("complete", str(verdicts["complete"]), f"of {len(done)}"),
        ("excess before", number(before), "median over sets"),
        ("excess after", number(after), "median over sets"),
    ]
    if days:
        span = (days[-1] - days[0]).days
        rows.append(("days", str(span), f"{days[0]:%Y-%m-%d} to {days[-1]:%Y-%m-%d}"))
    return rows


def _drift(drift: Drift, times: dict[str, Any]) -> dict[str, Any]:
    shown = [p for p in drift.pairs if p.together][:MOST_SHOWN] or list(drift.pairs[:1])
    of_time = [chart for p in shown[:1] if (chart := time_chart(p, times)) is not None]
    return {
        "title": f"What drifts together over {drift.over}",
        "about": "Each headset's mean departure is one point."
        if drift.over == "headsets"
        else "Each set is compared with the mean of its own headset, so differences between headsets play no part.",
        "pairs": pairs_chart(drift.pairs[:MOST_PAIRS]) if drift.pairs else None,
        "more": max(0, len(drift.pairs) - MOST_PAIRS),
        "charts": [(pair_chart(p), correlation_text(p)) for p in shown],
        "time": of_time[0] if of_time else None,
        "rows": [
            {
                "first": label(p.first.number),
                "second": label(p.second.number),
                "correlation": two_places(p.correlation),
                "interval": " to ".join(map(two_places, p.ci95)),
                "by_error": two_places(p.by_error),
                "count": len(p.first.values),
                "together": p.together,
            }
            for p in drift.pairs
        ],
        "tried": drift.tried,
    }


def _effects(done: Sequence[SetResult]) -> Any:
    counts = Counter(e for r in done for e in r.effects).most_common()
    return effects_chart(counts, len(done)) if counts else None


def _varying(drifts: Sequence[Drift]) -> list[dict[str, str]]:
    """The numbers that vary most over their error, over headsets or over time."""
    both: dict[Any, dict[str, Departures]] = {}
    for drift in drifts:
        for one in drift.departures:
            if one.free > 1 and one.spread > 0:
                both.setdefault(one.number.key, {})[drift.over] = one
    ranked = sorted(both.values(), key=lambda d: min(one.error_share for one in d.values()))
    rows = []
    for found in ranked[:MOST_VARYING]:
        over, of_sets = found.get("headsets"), found.get("time")
        any_of = next(iter(found.values()))
        rows.append(
            {
                "name": label(any_of.number),
                "mean": number(float(over.values.mean())) if over else "–",
                "headsets": number(over.spread) if over else "–",
                "time": number(of_sets.spread) if of_sets else "–",
                "error": number((of_sets or any_of).error, 2),
            }
        )
    return rows


def _set(result: SetResult) -> dict[str, Any]:
    facts = result.facts
    return {
        "folder": Path(facts.folder).name,
        "path": facts.folder,
        "headset": facts.headset,
        "time": f"{facts.time:%Y-%m-%d %H:%M}" if facts.time else "–",
        "time_from": facts.time_from or "",
        "verdict": plain(result.verdict) if result.verdict else "failed",
        "tone": VERDICTS.get(result.verdict or "", "bad"),
        "before": number(result.excess_before),
        "after": number(result.excess_after),
        "noise": percent(result.noise_nrmse),
        "effects": ", ".join(plain(e) for e in result.effects) or "–",
        "seconds": f"{result.seconds:.1f}",
        "warnings": list(result.warnings),
    }


def _median(values: Sequence[float]) -> float | None:
    ordered = sorted(values)
    return ordered[len(ordered) // 2] if ordered else None
