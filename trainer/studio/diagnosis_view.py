"""Diagnose, Explain and Cancel, the verdict, and the candidates with what each would change in the picture."""

from __future__ import annotations

from html import escape
from typing import Any

import panel as pn

from trainer.diagnosis.ranking import RankedEffect
from trainer.diagnosis.verdict import Thresholds
from trainer.formatting import number
from trainer.report.candidates import MOST, candidate_html, least_worth_adding, preview_html, ranking_html
from trainer.report.diagnosis_sections import VERDICTS
from trainer.studio.project import Project
from trainer.studio.running_work import Work
from trainer.studio.visit import LiveText, Visit


def diagnosis_view(project: Project, visit: Visit) -> Any:
    """The buttons, the progress and the verdict."""
    diagnose = pn.widgets.Button(name="Diagnose", css_classes=["main-button"], margin=0)
    explain = pn.widgets.Button(name="Explain", css_classes=["plain-button"], margin=0)
    cancel = pn.widgets.Button(name="Cancel", css_classes=["plain-button"], margin=0)
    label = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    verdict = LiveText(sizing_mode="stretch_width", css_classes=["verdict"])
    progress = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    diagnose.on_click(lambda _: project.diagnose())
    explain.on_click(lambda _: project.explain())
    cancel.on_click(lambda _: project.cancel())

    def work() -> None:
        idle = project.work is None
        usable = idle and project.set.captures is not None and not project.set.misread
        diagnose.disabled = explain.disabled = not usable
        cancel.disabled = idle
        progress.object = "" if project.work is None else progress_html(project.work)

    def show() -> None:
        found = project.results.diagnosis
        tone, words = VERDICTS[found.verdict] if found is not None else ("plain", "")
        label.object = f"<p class='tone {tone}'>{words}</p>" if words else ""
        verdict.tone, verdict.text = tone, project.results.verdict or _first_words(project)

    visit.on("job set", work)
    visit.on("diagnosis errors set model", show)
    return pn.Column(
        pn.FlexBox(diagnose, explain, cancel, gap="8px"),
        progress,
        label,
        verdict,
        css_classes=["card"],
        sizing_mode="stretch_width",
    )


def progress_html(work: Work) -> str:
    """How far work is, and how long it still takes."""
    left = work.seconds_left
    words = "" if left is None else f", about {_time(left)} left"
    return (
        f"<div class='progress'><progress max='1' value='{work.share:.3f}' aria-label='{escape(work.name)}'></progress>"
        f"<span>{escape(work.name)}: {escape(work.what)}{words}</span></div>"
    )


def _time(seconds: float) -> str:
    return f"{max(1, round(seconds))} s" if seconds < 90 else f"{round(seconds / 60)} min"


def _first_words(project: Project) -> str:
    """What the numbers say before anything was diagnosed."""
    if project.set.fault:
        return project.set.fault
    if project.set.misread:
        return "Correct the captures first: every number would be wrong."
    errors = project.set.errors
    if errors is None:
        return "Comparing the model with captures that no fit saw …"
    one = errors.errors
    if one.excess < Thresholds().complete_excess:
        return (
            "On captures that no fit saw, the model agrees with the bench to the camera's noise "
            f"(excess {number(one.excess, 2)})."
        )
    times = one.nrmse / one.noise_nrmse if one.noise_nrmse else 0
    return (
        f"On captures that no fit saw, the model's error is {number(times, 2)} times the camera's noise "
        f"(excess {number(one.excess, 2)}). Diagnose says what is missing; Explain goes all the way."
    )


def candidates_view(project: Project, visit: Visit) -> Any:
    """The ranking: each candidate with its interval, its size, and what it would change in the picture."""
    place = pn.Column(sizing_mode="stretch_width", css_classes=["candidates"])
    buttons: list[Any] = []
    shown: list[Any] = []

    def show() -> None:
        now = [project.results.ranking, *project.results.previews.values()]
        if len(shown) == len(now) and all(a is b for a, b in zip(shown, now, strict=True)):
            return  # a button that is replaced while somebody clicks it does nothing
        shown[:] = now
        ranking, found = project.results.ranking, project.results.diagnosis
        buttons.clear()
        if not ranking:
            place[:] = []
            return
        least = None if found is None else least_worth_adding(found.as_json())
        forest = ranking_html([r.as_json() for r in ranking], least)
        rows: list[Any] = [_wide(f"<h2>Candidates</h2>{forest}", "card")]
        rows += [_candidate(project, r, least, buttons) for r in ranking[:MOST]]
        if found is not None and found.suggested_captures:
            items = "".join(f"<li>{escape(s)}</li>" for s in found.suggested_captures)
            rows.append(_wide(f"<h3>Captures that would decide more</h3><ul>{items}</ul>"))
        place[:] = rows
        busy()

    def busy() -> None:
        for button in buttons:
            button.disabled = project.work is not None

    visit.on("diagnosis model", show)
    visit.on("job", busy)
    return place


def _wide(html: str, *classes: str) -> Any:
    return pn.pane.HTML(html, margin=0, sizing_mode="stretch_width", css_classes=list(classes))


def _candidate(project: Project, one: RankedEffect, least: float | None, buttons: list[Any]) -> Any:
    button = pn.widgets.Button(name=f"Add {one.effect.name}", css_classes=["plain-button"], margin=0)
    button.on_click(lambda _: project.add(one.effect.name))
    buttons.append(button)
    text = str(candidate_html(one.as_json(), least))
    half = {"flex": "1 1 190px"}
    words = pn.Column(pn.pane.HTML(text, margin=0, sizing_mode="stretch_width"), button, styles=half)
    pictures = str(preview_html(project.results.previews.get(one.effect.name)))
    return pn.FlexBox(
        words, pn.pane.HTML(pictures, margin=0, styles=half), gap="12px", css_classes=["card", "candidate"]
    )
