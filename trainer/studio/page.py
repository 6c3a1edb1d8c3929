"""The page: its frame, its sections, and one visit for each browser that opens it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import panel as pn

from trainer.report.html_report import LOOK
from trainer.studio.catalogue_view import catalogue_view
from trainer.studio.comparison_view import comparison_view
from trainer.studio.diagnosis_view import candidates_view, diagnosis_view
from trainer.studio.failures_view import failures_view
from trainer.studio.findings_view import findings_view
from trainer.studio.gain_view import gain_view
from trainer.studio.head_view import head_view, notice_view
from trainer.studio.ladder_view import ladder_view
from trainer.studio.light_path_view import light_path_view
from trainer.studio.outside_view import outside_view
from trainer.studio.project import Project
from trainer.studio.start_view import start_view
from trainer.studio.visit import Visit

# Served as files, which the browser reads once: copied into each component they would be nearly all of the page.
STYLE_FOLDERS = {"look": LOOK, "controls": Path(__file__).with_name("look")}
STYLES = ("look/page.css", "controls/studio.css")
FRAME = Path(__file__).with_name("studio.html")
PULSE_MS = 1000
SECTIONS = ("Bench", "No name fits", "Gain", "Catalogue")


def prepare() -> None:
    """Load what every page needs."""
    pn.extension(css_files=list(STYLES), loading_indicator=False, notifications=False)


def studio_page(project: Project) -> Any:
    """The page of one browser."""
    document = pn.state.curdoc
    assert document is not None
    theme = str(pn.state.cookies.get("hololoop_theme", "auto"))
    system = str(pn.state.cookies.get("hololoop_system", "light"))
    visit = Visit(project, document, dark=(system if theme == "auto" else theme) == "dark")
    frame = pn.Template(FRAME.read_text(encoding="utf-8"))
    frame.add_variable("styles", STYLES)
    frame.add_variable("theme", "dark" if visit.dark else "light")
    frame.add_variable("follows", theme not in ("light", "dark"))
    frame.add_panel("head", head_view(project, visit, theme))
    work = pn.Column(sizing_mode="stretch_width", css_classes=["work"])
    frame.add_panel("work", work)  # while it is empty, which is quicker
    _fill(work, project, visit)
    pn.state.onload(partial(_keep_sending, work))
    return frame


def _keep_sending(place: Any) -> None:
    """Change each second what nobody sees: Panel may leave a change in its queue until the next one."""

    def pulse() -> None:
        place.tags = [] if place.tags else ["pulse"]

    pn.state.add_periodic_callback(pulse, period=PULSE_MS)


def _fill(place: Any, project: Project, visit: Visit) -> None:
    """Show the start page, or the work on a set of captures."""
    shown: list[Path | None] = []

    def show() -> None:
        if shown == [project.set.folder]:
            return
        shown[:] = [project.set.folder]
        visit.capture = ""
        if project.set.folder is None:
            place[:] = [notice_view(project, visit), start_view(project, visit)]
        else:
            place[:] = [
                notice_view(project, visit),
                findings_view(project, visit),
                light_path_view(project, visit),
                _sections(project, visit),
            ]

    visit.on("set", show)


def _sections(project: Project, visit: Visit) -> Any:
    """The sections, each made when it is first opened; buttons choose, so that the keyboard can, too."""
    place = pn.Column(sizing_mode="stretch_width")
    made: dict[str, Any] = {}
    makers = {
        "Bench": _bench,
        "No name fits": outside_view,
        "Gain": gain_view,
        "Catalogue": _catalogue,
    }
    buttons = {name: pn.widgets.Button(name=name, css_classes=["section"]) for name in SECTIONS}

    def open_section(name: str) -> None:
        if name not in made:
            made[name] = makers[name](project, visit)
        place[:] = [made[name]]
        for other, button in buttons.items():
            button.css_classes = ["section", "current"] if other == name else ["section"]

    for name, button in buttons.items():
        button.on_click(partial(_opened, open_section, name))
    open_section("Bench")
    visit.on(
        "effects", lambda: made.pop("Catalogue", None) and None, now=False
    )  # made again when it is next opened
    return pn.Column(
        pn.FlexBox(*buttons.values(), css_classes=["sections"], gap="4px"), place, sizing_mode="stretch_width"
    )


def _opened(open_section: Callable[[str], None], name: str, _: Any) -> None:
    open_section(name)


def _bench(project: Project, visit: Visit) -> Any:
    left = pn.Column(comparison_view(project, visit), styles={"flex": "3 1 540px", "min-width": "0"})
    right = pn.Column(
        diagnosis_view(project, visit),
        ladder_view(project, visit),
        styles={"flex": "2 1 340px", "min-width": "0"},
    )

    def rest() -> None:
        """What stands below is made when the first view is on the screen."""
        left.append(failures_view(project, visit))
        right.append(candidates_view(project, visit))

    pn.state.onload(rest)
    return pn.FlexBox(left, right, gap="16px", sizing_mode="stretch_width", align_items="flex-start")


def _catalogue(project: Project, visit: Visit) -> Any:
    """The catalogue of effects, with pictures that move."""
    return catalogue_view(project.effects.known)
