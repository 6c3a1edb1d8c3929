"""The head of the page: which captures and model, undo and redo, the theme; and the sentence of what just happened."""

from __future__ import annotations

from html import escape
from typing import Any

import panel as pn

from firmware_iface.errors import InputError
from trainer.studio.project import Project
from trainer.studio.visit import LiveText, Visit

KEEP_THEME = (
    "document.cookie = 'hololoop_theme=' + cb_obj.value + ';path=/;max-age=31536000'; location.reload()"
)


def head_view(project: Project, visit: Visit, theme: str) -> Any:
    """Names of captures and model, and the controls that hold everywhere."""
    names = pn.pane.HTML("", css_classes=["names"], margin=0)
    undo = pn.widgets.Button(name="Undo", css_classes=["quiet-button"], margin=0)
    redo = pn.widgets.Button(name="Redo", css_classes=["quiet-button"], margin=0)
    other = pn.widgets.Button(name="Other captures", css_classes=["quiet-button"], margin=0)
    choice = pn.widgets.Select(
        name="Theme",
        options={"system": "auto", "light": "light", "dark": "dark"},
        value=theme if theme in ("light", "dark") else "auto",
        width=132,
        margin=0,
        css_classes=["inline-label"],
    )
    choice.jscallback(value=KEEP_THEME)

    def leave(_: Any) -> None:
        try:
            project.close_set()
        except InputError as error:
            project.say(str(error), "error")

    undo.on_click(lambda _: project.undo())
    redo.on_click(lambda _: project.redo())
    other.on_click(leave)

    def show() -> None:
        folder, path = project.set.folder, project.set.model_path
        if folder is None or path is None:
            names.object = ""
        else:
            kept = escape(path.name) if path.is_file() else f"{escape(path.name)} (at the first change)"
            names.object = (
                f"<span>Captures <b title='{escape(str(folder))}'>{escape(folder.name)}</b></span>"
                f"<span>Model <b title='{escape(str(path))}'>{kept}</b></span>"
            )
        busy = project.work is not None
        undo.disabled, redo.disabled = busy or not project.set.can_undo(), busy or not project.set.can_redo()
        for button in (undo, redo, other):
            button.visible = folder is not None

    visit.on("set model job diagnosis", show)
    return pn.FlexBox(
        names, undo, redo, other, choice, gap="8px", align_items="center", justify_content="flex-end"
    )


def notice_view(project: Project, visit: Visit) -> Any:
    """The sentence of what just happened, in a live region."""
    text = LiveText(sizing_mode="stretch_width")

    def show() -> None:
        severity, sentence = project.notice
        if not sentence and project.effects.fault:
            severity, sentence = "error", project.effects.fault
        if not sentence and project.set.fault:
            severity, sentence = "error", project.set.fault
        text.text, text.tone = sentence, "bad" if severity == "error" else "plain"
        text.visible = bool(sentence)

    visit.on("notice effects set", show)
    return text
