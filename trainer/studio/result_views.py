"""The page's views of results alone, without a project: for notebooks, and for files of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from html import escape
from typing import Any

import numpy as np
import panel as pn

from trainer.diagnosis.comparison import CapturePicture, Comparison
from trainer.diagnosis.diagnosis import Diagnosis
from trainer.model.model import Model
from trainer.report.candidates import MOST, candidate_html, least_worth_adding, preview_html, ranking_html
from trainer.report.diagnosis_sections import VERDICTS, stages, stages_html
from trainer.report.html_report import page_style
from trainer.report.ladder import ladder_html, ladder_rows
from trainer.report.light_path import light_path_html
from trainer.studio.colours import line_colours
from trainer.studio.failure_figures import FailureFigures
from trainer.studio.job_tasks import shown_as
from trainer.studio.linked_pictures import KINDS, TITLES, LinkedPictures

CELL = {"flex": "1 1 200px"}


def verdict_view(found: Diagnosis) -> Any:
    """The verdict in a sentence."""
    tone, label = VERDICTS[found.verdict]
    return _html(f"<p class='tone {tone}'>{label}</p><p>{escape(found.sentence)}</p>")


def light_path_view(model: Model, found: Diagnosis | None) -> Any:
    """The stages with their effects, shaded by what each one's probe would remove."""
    return _html(str(light_path_html(model, None if found is None else found.as_json())))


def pictures_view(pictures: Sequence[CapturePicture]) -> Any:
    """Measured, predicted and difference of a few captures, with linked pan and zoom."""
    rows = []
    for one in pictures:
        linked = LinkedPictures(one.measured.shape)
        linked.show(
            shown_as(one.capture, one.measured, one.predicted, np.isfinite(one.difference), None), None
        )
        cells = [
            pn.Column(
                _html(f"<h3>{TITLES[kind]}, {escape(one.capture)}</h3>"),
                pn.pane.Bokeh(linked.figure(kind), sizing_mode="scale_width"),
                styles=CELL,
            )
            for kind in KINDS
        ]
        rows.append(pn.FlexBox(*cells, sizing_mode="stretch_width"))
    return pn.Column(*rows, sizing_mode="stretch_width")


def failures_view(found: Comparison) -> Any:
    """Where the model fails: over the field, over spatial frequency, over brightness, over time."""
    shape = found.model.bench.camera.shape
    return FailureFigures(found.as_json()["where"], shape, line_colours(False)).view


def ladder_view(steps: Sequence[Mapping[str, Any]], noise: float | None) -> Any:
    """The error after each step."""
    return _html(f"<h2>Ladder of errors</h2>{ladder_html(ladder_rows(steps), noise)}")


def candidates_view(found: Diagnosis) -> Any:
    """The ranking with intervals, and what each candidate would change in the picture."""
    ranking = found.as_json()["ranking"]
    if not ranking:
        return _html("<p class='quiet'>There are no candidates.</p>")
    least = least_worth_adding(found.as_json())
    drawn = {p.effect: p for p in found.previews}
    cards = [
        pn.FlexBox(_html(candidate_html(r, least)), _html(preview_html(drawn.get(r["effect"]))))
        for r in ranking[:MOST]
    ]
    return pn.Column(
        _html(f"<h2>Candidates</h2>{ranking_html(ranking, least)}"), *cards, sizing_mode="stretch_width"
    )


def probes_view(found: Diagnosis) -> Any:
    """What each stage's free-form probe has found."""
    section = stages(found.as_json(), found.probe_pictures)
    if section is None:
        return _html("<p class='quiet'>No probe was fitted.</p>")
    return _html(f"<h2>What each stage lacks</h2>{stages_html(section)}")


def together(views: Mapping[str, Callable[[], Any]], names: Sequence[str]) -> Any:
    """Some views above each other, all without names."""
    return pn.Column(*(views[name]() for name in names or views), sizing_mode="stretch_width")


def _html(text: str) -> Any:
    return pn.pane.HTML(text, sizing_mode="stretch_width", margin=4, stylesheets=[_style()])


@lru_cache(maxsize=1)
def _style() -> str:
    """The page's style for a part that stands in a page of others: light, as their plots are."""
    return page_style().replace(":root {", ":host {", 1) + ":host { color-scheme: light; color: var(--ink); }"
