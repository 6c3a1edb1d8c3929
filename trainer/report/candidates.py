"""The candidates of a diagnosis: the ranking with intervals, and what each would change in the picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from trainer.formatting import number, parameters, plain
from trainer.report.charts import forest_plot, is_worth
from trainer.report.heat_maps import picture_uri
from trainer.report.palettes import DIFFERENCE

MOST = 6  # candidates that are shown with pictures
MOST_VALUES = 4
NAMED = Markup(
    '<h3>{name} <span class="quiet">{stage}</span></h3><p class="small">removes {removed}{interval}, leaves {after}'
    '{worth}</p><p class="small quiet">{values}</p>{alike}'
)
PICTURE = Markup('<figure><img src="{uri}" alt="{alt}"><figcaption>{words}</figcaption></figure>')


def ranking_html(rows: Sequence[Mapping[str, Any]], least: float | None) -> Markup:
    """The excess that each candidate removes, with its interval.

    Parameters
    ----------
    rows : sequence of mapping
        Under `ranking` of `diagnose --json`.
    least : float or None
        Excess that an effect must remove to be worth adding.
    """
    return Markup(
        '<div class="forest">{}</div><p class="small quiet">Filled marks are worth adding.</p>'
    ).format(forest_plot(rows, least))


def least_worth_adding(found: Mapping[str, Any]) -> float | None:
    """Excess that an effect must remove to be worth adding; None where the diagnosis does not say."""
    limits, ideal = found.get("thresholds"), found.get("ideal_excess")
    return max(limits["share"] * (ideal or 0.0), limits["excess"]) if limits else None


def candidate_html(row: Mapping[str, Any], least: float | None) -> Markup:
    """One candidate in words: what it removes, its parameters, and what these captures cannot tell it from."""
    interval = row.get("ci95")
    values = [f"{p.name} {p.text}" for p in parameters(row.get("parameters"))]
    alike = Markup("")
    if row.get("indistinguishable_from"):
        names = " or ".join(plain(n) for n in row["indistinguishable_from"])
        alike = Markup('<p class="small warn-text">These captures cannot tell it from {}.</p>').format(names)
    return NAMED.format(
        name=plain(row["effect"]),
        stage=row["stage"],
        removed=number(row["excess_removed"]),
        interval="" if interval is None else f" ({number(interval[0])} to {number(interval[1])})",
        after=number(row.get("excess_after")),
        worth="" if is_worth(row, least) else "; not worth adding",
        values=", ".join(values[:MOST_VALUES]),
        alike=alike,
    )


def preview_html(preview: Any) -> Markup:
    """What is missing in a picture, and what the candidate would put there, on one scale.

    Parameters
    ----------
    preview : trainer.diagnosis.previews.CandidatePreview or None
    """
    if preview is None:
        return Markup("")
    scale = (-preview.scale, preview.scale)
    pictures = Markup("").join(
        PICTURE.format(uri=picture_uri(values, scale, DIFFERENCE), alt=alt, words=words)
        for values, words, alt in (
            (preview.missing, "missing now", f"Measured less predicted in capture {preview.capture}"),
            (preview.change, "it would add", f"What {plain(preview.effect)} would add to the prediction"),
        )
    )
    return Markup('<div class="pair">{}</div>').format(pictures)
