"""The light path across the top, live."""

from __future__ import annotations

from typing import Any

import panel as pn

from trainer.report.light_path import light_path_html
from trainer.studio.project import Project
from trainer.studio.visit import Visit


def light_path_view(project: Project, visit: Visit) -> Any:
    """The stages with their effects, as in reports."""
    pane = pn.pane.HTML("", sizing_mode="stretch_width", margin=0, css_classes=["light-path"])

    def show() -> None:
        model, found, learned = project.set.model, project.results.diagnosis, project.set.network
        network = None if learned is None else (learned.before, learned.after)
        shown = (
            ""
            if model is None
            else light_path_html(model, None if found is None else found.as_json(), network)
        )
        pane.object = str(shown)

    visit.on("set model diagnosis", show)
    return pane
