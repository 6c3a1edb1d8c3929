"""Diagnose, Explain and Cancel, the verdict, and the candidates with what each would change in the picture."""

from __future__ import annotations

from html import escape
from typing import Any

import panel as pn

from trainer.diagnosis.ranking import RankedEffect
from trainer.diagnosis.verdict import Thresholds
from trainer.formatting import number, plain
from trainer.model.parameters import describe
from trainer.studio.difference_pictures import difference_uri
from trainer.studio.project import Project
from trainer.studio.running_work import Work
from trainer.studio.visit import LiveText, Visit

MOST = 6
TONES = {"complete": "good", "missing": "warn", "outside_catalogue": "bad"}
LABELS = {
    "complete": "Complete",
    "missing": "Something is missing",
    "outside_catalogue": "Something outside the catalogue is missing",
}


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
        tone = TONES[found.verdict] if found is not None else "plain"
        label.object = "" if found is None else f"<p class='tone {tone}'>{LABELS[found.verdict]}</p>"
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
        ranking = project.results.ranking[:MOST]
        buttons.clear()
        if not ranking:
            place[:] = []
            return
        top = max([r.removed.interval()[1] for r in ranking] + [1e-12])
        rows: list[Any] = [pn.pane.HTML("<h2>Candidates</h2>", margin=0)]
        rows += [_candidate(project, r, top, buttons) for r in ranking]
        found = project.results.diagnosis
        if found is not None and found.suggested_captures:
            items = "".join(f"<li>{escape(s)}</li>" for s in found.suggested_captures)
            rows.append(pn.pane.HTML(f"<h3>Captures that would decide more</h3><ul>{items}</ul>", margin=0))
        place[:] = rows
        busy()

    def busy() -> None:
        for button in buttons:
            button.disabled = project.work is not None

    visit.on("diagnosis model", show)
    visit.on("job", busy)
    return place


def _candidate(project: Project, one: RankedEffect, top: float, buttons: list[Any]) -> Any:
    low, high = one.removed.interval()
    left, right = (100 * max(0.0, min(1.0, v / top)) for v in (low, high))
    middle = 100 * max(0.0, min(1.0, one.removed.value / top))
    alike = ""
    if one.indistinguishable_from:
        names = " or ".join(plain(n) for n in one.indistinguishable_from)
        alike = f"<p class='small warn-text'>These captures cannot tell it from {escape(names)}.</p>"
    size = describe(one.model.instance(one.effect.name), one.model.bench)
    text = (
        f"<h3>{escape(plain(one.effect.name))} <span class='quiet'>{one.effect.stage}</span></h3>"
        f"<div class='interval' role='img' aria-label='removes {number(one.removed.value)}, 95 % interval "
        f"{number(low)} to {number(high)}'><i style='left:{left:.1f}%;width:{max(right - left, 0.5):.1f}%'></i>"
        f"<b style='left:{middle:.1f}%' class='{'worth' if one.worth_adding else ''}'></b></div>"
        f"<p class='small'>removes {number(one.removed.value)} ({number(low, 2)} to {number(high, 2)}), "
        f"leaves {number(one.held_out.excess)}{'' if one.worth_adding else '; not worth adding'}</p>"
        f"<p class='small quiet'>{escape(size[:160])}</p>{alike}"
    )
    button = pn.widgets.Button(name=f"Add {one.effect.name}", css_classes=["plain-button"], margin=0)
    button.on_click(lambda _: project.add(one.effect.name))
    buttons.append(button)
    words = pn.Column(
        pn.pane.HTML(text, margin=0, sizing_mode="stretch_width"), button, styles={"flex": "1 1 190px"}
    )
    return pn.FlexBox(words, _pictures(project, one), gap="12px", css_classes=["card", "candidate"])


def _pictures(project: Project, one: RankedEffect) -> Any:
    """What is missing in a picture, and what the candidate would put there, on one scale."""
    preview = project.results.previews.get(one.effect.name)
    if preview is None:
        return pn.pane.HTML("", margin=0)
    pictures = "".join(
        f"<figure><img src='{difference_uri(values, preview.scale)}' alt='{alt}'>"
        f"<figcaption>{words}</figcaption></figure>"
        for values, words, alt in (
            (preview.missing, "missing now", f"Measured less predicted in capture {escape(preview.capture)}"),
            (
                preview.change,
                "it would add",
                f"What {escape(plain(one.effect.name))} would add to the prediction",
            ),
        )
    )
    return pn.pane.HTML(f"<div class='pair'>{pictures}</div>", margin=0, styles={"flex": "1 1 190px"})
