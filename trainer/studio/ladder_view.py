"""The ladder of errors: the held-out error after each step, with the camera's noise as the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import panel as pn

from trainer.formatting import number, percent
from trainer.report.charts import ladder_chart
from trainer.studio.project import Project
from trainer.studio.visit import Visit


def ladder_rows(history: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The steps of a model's history as a person counts them: keys `label`, `nrmse`, `noise_nrmse` and `excess`."""
    rows: list[dict[str, Any]] = []
    for record in history:
        if not isinstance(record.get("nrmse"), float):
            continue
        if record.get("removed"):
            label = f"− {record['removed']}"
        elif record.get("added"):
            label = f"+ {record['added']}"
        elif rows:
            continue  # the start of a later explanation
        else:
            label = "ideal model"
        rows.append(
            {
                "label": label.replace("_", " "),
                **{k: record.get(k) for k in ("nrmse", "noise_nrmse", "excess")},
            }
        )
    return rows


def ladder_view(project: Project, visit: Visit) -> Any:
    """The chart of the ladder, as in reports, and its numbers."""
    pane = pn.pane.HTML("", sizing_mode="stretch_width", margin=0, css_classes=["card", "ladder"])

    def show() -> None:
        rows = ladder_rows(project.set.model.history) if project.set.model is not None else []
        if not rows and project.set.errors is not None:
            rows = [{"label": "ideal model", **project.set.errors.errors.as_json()}]
        if not rows:
            pane.object = (
                "<h2>Ladder of errors</h2><p class='quiet'>Comparing with the held-out captures …</p>"
            )
            return
        chart = ladder_chart([r["label"] for r in rows], [r["nrmse"] for r in rows], rows[-1]["noise_nrmse"])
        last = rows[-1]
        pane.object = (
            f"<h2>Ladder of errors</h2>{chart}<p class='small'>Error now <b>{percent(last['nrmse'])}</b> of the "
            f"signal's spread; the camera's noise alone <b>{percent(last['noise_nrmse'])}</b>; "
            f"excess <b>{number(last['excess'])}</b>.</p>"
        )

    visit.on("set model errors", show)
    return pane
