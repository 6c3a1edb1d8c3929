"""What `check` found, first of all, with the change to make, and a button where a line of a table is that change."""

from __future__ import annotations

from functools import partial
from html import escape
from typing import Any

import panel as pn

from firmware_iface.errors import InputError
from trainer.studio.findings_fixes import Fix, fix_of
from trainer.studio.jobs import sentence_of
from trainer.studio.project import Project
from trainer.studio.visit import Visit

MOST = 12


def findings_view(project: Project, visit: Visit) -> Any:
    """The check's findings, errors first."""
    place = pn.Column(sizing_mode="stretch_width", css_classes=["findings"])

    def show() -> None:
        found = project.set.problems
        if found is None:
            place[:] = [_text("<p class='quiet'>Checking the captures …</p>")]
            return
        if not found:
            count = len(project.set.captures or ())
            place[:] = [
                pn.pane.HTML(
                    f"<p class='sound'>{count} captures, and nothing is wrong with them.</p>", margin=0
                )
            ]
            return
        ordered = sorted(found, key=lambda p: p.severity != "error")
        errors = sum(p.severity == "error" for p in found)
        words = f"{_count(errors, 'error')} and {_count(len(found) - errors, 'warning')}"
        rows: list[Any] = [_text(f"<h2>Check of the captures: {words}</h2>")]
        for problem in ordered[:MOST]:
            text = (
                f"<p class='finding {problem.severity}'><b>{problem.severity}, {escape(problem.kind.replace('_', ' '))}"
                f"</b> {escape(problem.message)}</p>"
            )
            row: list[Any] = [pn.pane.HTML(text, margin=0, styles={"flex": "1 1 320px"})]
            fix = fix_of(project.set.folder, problem) if project.set.folder is not None else None
            if fix is not None:
                button = pn.widgets.Button(name=fix.what, css_classes=["main-button"], margin=0)
                button.on_click(partial(_clicked, project, fix))
                row.append(button)
            rows.append(pn.FlexBox(*row, gap="10px", align_items="center"))
        if len(found) > MOST:
            more = len(found) - MOST
            rows.append(
                pn.pane.HTML(
                    f"<p class='quiet'>and {more} more: hololoop-trainer check lists all.</p>", margin=0
                )
            )
        place[:] = rows

    visit.on("set", show)
    return place


def _text(html: str) -> Any:
    return pn.pane.HTML(html, margin=0)


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'s' * (number != 1)}"


def _clicked(project: Project, fix: Fix, _: Any) -> None:
    _apply(project, fix)


def _apply(project: Project, fix: Any) -> None:
    try:
        kept = fix.apply()
    except (InputError, OSError) as error:
        project.say(sentence_of(error), "error")
        return
    project.read_again()
    project.say(f"Done: {fix.what}. The old file is kept as {kept.name}.")
