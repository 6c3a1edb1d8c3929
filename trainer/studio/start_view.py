"""The start page: a folder of captures, or a simulated bench whose defects are hidden."""

from __future__ import annotations

import secrets
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import panel as pn
from PIL import Image

from firmware_iface.errors import InputError
from trainer.report.png_uri import png_uri
from trainer.studio.diagnosis_view import progress_html
from trainer.studio.guess_benches import KINDS, capture_guess
from trainer.studio.project import Project
from trainer.studio.visit import Visit

MOST_SETS = 40
DEEP = 3  # folders below the present one in which sets are looked for


def capture_sets_below(home: Path) -> list[Path]:
    """Folders with bench.toml and captures.csv, in the present one and below it."""
    found: list[Path] = []
    level = [home]
    for _ in range(DEEP + 1):
        following: list[Path] = []
        for folder in level:
            if (folder / "bench.toml").is_file() and (folder / "captures.csv").is_file():
                found.append(folder)
                continue
            try:
                inside = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
            except OSError:
                continue
            following += inside[:MOST_SETS]
        level = following[: 10 * MOST_SETS]
    return found[:MOST_SETS]


def start_view(project: Project, visit: Visit) -> Any:
    """The choice, and the pictures of a simulated bench as they are taken."""
    found = {
        str(p.relative_to(project.home)) if p != project.home else p.name: p
        for p in capture_sets_below(project.home)
    }
    sets = pn.widgets.Select(name="Capture sets found here", options=list(found), width=340, margin=0)
    path = pn.widgets.TextInput(name="Path of a folder", placeholder="/home/me/captures", width=340, margin=0)
    opens = pn.widgets.Button(name="Open", css_classes=["main-button"], margin=0)
    kind = pn.widgets.Select(name="Simulated bench", options=list(KINDS), width=340, margin=0)
    captures = pn.widgets.Button(name="Capture", css_classes=["main-button"], margin=0)
    cancel = pn.widgets.Button(name="Cancel", css_classes=["plain-button"], margin=0)
    progress = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    picture = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    sets.visible = bool(found)

    def open_folder(_: Any) -> None:
        typed = path.value_input or path.value
        chosen = Path(typed).expanduser() if typed else found.get(sets.value)
        if chosen is None:
            project.say("Give the path of a folder with bench.toml and captures.csv.", "error")
            return
        try:
            project.open_set(chosen)
        except InputError as error:
            project.say(str(error), "error")

    def take(_: Any) -> None:
        number = secrets.randbelow(9000) + 1000
        folder = project.home / f"guess-{number}"
        project.run(
            f"Capture {folder.name}", capture_guess, (KINDS[kind.value], number, folder), project.open_set
        )

    def work() -> None:
        busy = project.work is not None
        opens.disabled = captures.disabled = busy
        cancel.visible = busy
        progress.object = progress_html(project.work) if project.work is not None else ""
        if not busy:
            picture.object = ""

    def seen() -> None:
        work = project.work
        if isinstance(project.results.gain, np.ndarray) and work is not None:
            uri = _picture(project.results.gain)
            picture.object = (
                f"<figure class='live-picture'><img src='{uri}' alt='The last picture of the camera'>"
                f"<figcaption>What the camera sees: {escape(work.what)}</figcaption></figure>"
            )

    opens.on_click(open_folder)
    captures.on_click(take)
    cancel.on_click(lambda _: project.cancel())
    visit.on("job", work)
    visit.on("gain", seen)
    style = {"flex": "1 1 340px", "min-width": "0"}
    own = pn.Column(
        pn.pane.HTML(
            "<h2>Your captures</h2><p class='quiet'>A folder with bench.toml, captures.csv, the patterns "
            "that were sent to the panel and the raw pictures of the camera.</p>",
            margin=0,
        ),
        sets,
        path,
        opens,
        css_classes=["card", "choice"],
        styles=style,
    )
    guess = pn.Column(
        pn.pane.HTML(
            "<h2>Guess what is wrong</h2><p class='quiet'>A simulated bench with hidden defects is captured "
            "while you watch. Find out what is wrong with it, as you would with your own.</p>",
            margin=0,
        ),
        kind,
        pn.FlexBox(captures, cancel, gap="8px"),
        progress,
        picture,
        css_classes=["card", "choice"],
        styles=style,
    )
    words = pn.pane.HTML(
        "<p class='lead'>A holographic display shows a wrong picture wherever its optics differ from the model that "
        "its holograms were computed with. Give captures of yours; this page says what differs, and how much is "
        "gained when the model knows it.</p>",
        margin=0,
        sizing_mode="stretch_width",
    )
    return pn.Column(
        words, pn.FlexBox(own, guess, gap="16px", sizing_mode="stretch_width"), sizing_mode="stretch_width"
    )


def _picture(counts: np.ndarray) -> str:
    top = max(float(np.percentile(counts, 99.8)), 1.0)
    low = float(counts.min())
    share = np.clip((counts - low) / max(top - low, 1e-9), 0, 1)
    pixels = (matplotlib.colormaps["viridis"](share)[..., :3] * 255).astype(np.uint8)
    return png_uri(Image.fromarray(pixels))
