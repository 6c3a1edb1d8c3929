"""The ladder of errors: the held-out error after each step, with the camera's noise as the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from trainer.formatting import change_of, number, percent, plain
from trainer.report.charts import ladder_chart


def ladder_rows(history: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The steps of a model's history as a person counts them.

    Parameters
    ----------
    history : sequence of mapping
        Records with the keys `added`, `removed`, `refined`, `nrmse`, `excess` and, if known, `noise_nrmse` and
        `indistinguishable_from`.

    Returns
    -------
    list of dict
        Keys `label` (in words), `change` (with names as in a model file), `nrmse`, `noise_nrmse`, `excess`, `left`
        (share of the first step's excess, None where it had none) and `others`.
    """
    rows: list[dict[str, Any]] = []
    for record in history:
        if not isinstance(record.get("nrmse"), float):
            continue
        change = change_of(record)
        if rows and not change:
            continue  # the start of a later explanation
        change = change or "ideal model"
        rows.append(
            {
                "label": plain(change),
                "change": change,
                **{k: record.get(k) for k in ("nrmse", "noise_nrmse", "excess")},
                "others": record.get("indistinguishable_from") or [],
            }
        )
    first = rows[0]["excess"] if rows else None
    for row in rows:
        row["left"] = row["excess"] / first if first and first > 0 else None
    return rows


def with_network(rows: Sequence[Mapping[str, Any]], after: float) -> list[dict[str, Any]]:
    """The ladder with a learned network as its last step, given the excess with it."""
    last, first = rows[-1], rows[0]["excess"]
    noise = last["noise_nrmse"] or 0.0
    step = {"label": "+ network", "change": "+ network", "nrmse": (max(after, 0.0) + noise**2) ** 0.5}
    left = after / first if first and first > 0 else None
    return [*map(dict, rows), {**last, **step, "excess": after, "left": left, "others": []}]


def ladder_html(rows: Sequence[Mapping[str, Any]], noise: float | None) -> Markup:
    """The chart of the ladder, and its last step in numbers.

    Parameters
    ----------
    rows : sequence of mapping
        As from `ladder_rows`, at least one.
    noise : float or None
        The nrmse of the camera's noise alone.
    """
    chart = ladder_chart([r["label"] for r in rows], [r["nrmse"] for r in rows], noise)
    last = rows[-1]
    floor = Markup("; the camera's noise alone <b>{}</b>").format(percent(noise)) if noise else ""
    return Markup(
        '<div class="ladder">{}</div><p class="small">Error now <b>{}</b> of the signal\'s spread{}; '
        "excess <b>{}</b>.</p>"
    ).format(chart, percent(last["nrmse"]), floor, number(last["excess"]))
