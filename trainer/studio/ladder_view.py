"""The ladder of errors, live."""

from __future__ import annotations

from typing import Any

import panel as pn

from trainer.report.ladder import ladder_html, ladder_rows, with_network
from trainer.studio.project import Project
from trainer.studio.visit import Visit


def ladder_view(project: Project, visit: Visit) -> Any:
    """The chart of the ladder, as in reports, and its numbers."""
    pane = pn.pane.HTML("", sizing_mode="stretch_width", margin=0, css_classes=["card"])

    def show() -> None:
        rows = ladder_rows(project.set.model.history) if project.set.model is not None else []
        if not rows and project.set.errors is not None:
            rows = ladder_rows([project.set.errors.errors.as_json()])
        if not rows:
            words = "<p class='quiet'>Comparing with the held-out captures …</p>"
        else:
            if project.set.network is not None:
                rows = with_network(rows, project.set.network.after)
            words = str(ladder_html(rows, rows[-1]["noise_nrmse"]))
        pane.object = f"<h2>Ladder of errors</h2>{words}"

    visit.on("set model errors", show)
    return pane
