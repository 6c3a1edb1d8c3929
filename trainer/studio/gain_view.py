"""What is gained: the same target as displayed with patterns of the ideal and of the explained model; and export."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, LinearColorMapper, Range1d
from bokeh.palettes import Greys256
from bokeh.plotting import figure

from firmware_iface.errors import InputError
from trainer.captures.block_means import blocks
from trainer.studio.gain_tasks import (
    OWN,
    PICTURES,
    PREDICTED,
    GainPicture,
    keep,
    recorded,
    show_gain,
)
from trainer.studio.guess_benches import hidden_in, noted
from trainer.studio.job_tasks import SHOWN_PX
from trainer.studio.project import Project
from trainer.studio.visit import Visit

OTHER, RECORDED = "a bench or headset, by its name or file", "recorded: a file that was kept"
KINDS = {
    "target": "Target",
    "ideal": "Ideal model",
    "explained": "Explained model",
    "wipe": "Ideal | explained",
}


class _Pictures:
    """The four pictures on common axes."""

    def __init__(self) -> None:
        self.x, self.y = Range1d(start=0, end=1), Range1d(start=1, end=0)
        empty = [np.zeros((2, 2), np.float32)]
        self.source = ColumnDataSource({**{k: empty for k in KINDS}, "dw": [1], "dh": [1]})
        self.arrays: dict[str, np.ndarray] = {}

    def figure(self, kind: str, shape: tuple[int, int]) -> Any:
        """One of the pictures."""
        one: Any = figure(
            x_range=self.x, y_range=self.y, tools="pan,wheel_zoom,reset", active_scroll="wheel_zoom",
            toolbar_location=None, min_border=0, width=400, height=max(1, round(400 * shape[0] / shape[1])),
            sizing_mode="scale_width",
        )  # fmt: skip
        one.axis.visible = False
        one.grid.visible = False
        mapper = LinearColorMapper(palette=list(Greys256), low=0, high=1)
        one.image(kind, x=0, y=0, dw="dw", dh="dh", source=self.source, color_mapper=mapper)
        return one

    def show(self, found: GainPicture, share: float) -> None:
        """Show a displayed picture."""
        height, width = found.target.shape
        factor = max(1, -(-max(found.target.shape) // SHOWN_PX))
        self.arrays = {
            k: blocks(getattr(found, k), factor).astype(np.float32) for k in ("target", "ideal", "explained")
        }
        self.x.update(start=0, end=width)
        self.y.update(start=height, end=0)
        wiped = [self._wiped(share)]
        self.source.data = {
            **{k: [a] for k, a in self.arrays.items()},
            "wipe": wiped,
            "dw": [width],
            "dh": [height],
        }

    def wipe(self, share: float) -> None:
        """Move the edge between the ideal and the explained model's picture."""
        if self.arrays:
            self.source.patch({"wipe": [(0, self._wiped(share))]})

    def _wiped(self, share: float) -> np.ndarray:
        columns = np.arange(self.arrays["ideal"].shape[1])
        edge = share * len(columns)
        return np.where(columns < edge, self.arrays["ideal"], self.arrays["explained"]).astype(np.float32)


def gain_view(project: Project, visit: Visit) -> Any:
    """The pictures, what displays them, and the bundle for the headset."""
    if project.set.captures is None or project.set.folder is None:
        return pn.pane.HTML("<p class='quiet'>There are no captures yet.</p>", css_classes=["card"])
    captures = project.set.captures
    displays = [PREDICTED, OTHER, RECORDED]
    if noted(project.set.folder) is not None:
        displays.insert(0, OWN)
    picture = pn.widgets.Select(name="Target", options=list(PICTURES), width=120, margin=0)
    colour = pn.widgets.Select(name="Colour", options=list(captures.channels), width=100, margin=0)
    plane = pn.widgets.Select(
        name="Plane", options={f"{z:g} mm": z for z in captures.planes}, width=100, margin=0
    )
    where = pn.widgets.Select(name="Displayed by", options=displays, width=290, margin=0)
    other = pn.widgets.TextInput(
        name="virtual:NAME, or a file", placeholder="virtual:demo", width=220, margin=0
    )
    show_it = pn.widgets.Button(name="Show the gain", css_classes=["main-button"], margin=0)
    wipe = pn.widgets.IntSlider(name="Wipe, % of the width", start=0, end=100, value=50, width=240, margin=0)
    words = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    out = pn.widgets.TextInput(name="Folder of the bundle", value="bundle", width=220, margin=0)
    export = pn.widgets.Button(name="Export", css_classes=["main-button"], margin=0)
    reveal = pn.widgets.Button(name="Reveal what is hidden", css_classes=["plain-button"], margin=0)
    truth = pn.pane.HTML("", margin=0, sizing_mode="stretch_width")
    pictures = _Pictures()
    place = pn.FlexBox(gap="12px", sizing_mode="stretch_width")
    shown: list[GainPicture] = []
    other.visible = False
    reveal.visible = noted(project.set.folder) is not None

    def display(_: Any) -> None:
        if project.set.model is None or project.set.folder is None:
            return
        chosen = other.value_input or other.value if where.value in (OTHER, RECORDED) else where.value
        if not chosen:
            project.say("Give virtual:NAME, or the path of a file.", "error")
            return
        if where.value == RECORDED:
            try:
                project.show_gain(recorded(Path(chosen)))
            except InputError as error:
                project.say(str(error), "error")
            return
        arguments = (project.set.folder, project.set.model, picture.value, colour.value, plane.value, chosen)
        project.run("Show the gain", show_gain, arguments, _kept)

    def _kept(found: GainPicture) -> None:
        path = project.set.model_path
        if path is not None:
            file = path.with_name(f"{path.stem}-{found.name}.npz")
            keep(found, file)
            project.say(f"What was displayed is kept as {file.name}.")
        project.show_gain(found)

    def exported(_: Any) -> None:
        folder = project.home / (out.value_input or out.value or "bundle")
        project.export(folder)

    def show() -> None:
        found = project.results.gain
        if not isinstance(found, GainPicture):
            if not shown:
                words.object = (
                    "<p class='quiet'>Two patterns are computed for the target, one with each model.</p>"
                )
            return
        if not shown:
            made = {
                k: pn.pane.Bokeh(pictures.figure(k, found.target.shape), sizing_mode="scale_width", margin=0)
                for k in KINDS
            }
            place[:] = [
                pn.Column(
                    pn.pane.HTML(f"<h3>{KINDS[k]}</h3>", margin=0),
                    one,
                    styles={"flex": "1 1 240px", "min-width": "0"},
                    margin=0,
                )
                for k, one in made.items()
            ]
        shown[:] = [found]
        pictures.show(found, (wipe.value or 0) / 100)
        words.object = (
            f"<p>{escape(found.name.capitalize())}, {escape(found.channel)}, displayed by {escape(found.where)}: "
            f"<b>{found.ideal_db:.1f} dB</b> with the ideal model's pattern, <b>{found.explained_db:.1f} dB</b> with "
            "the explained model's.</p>"
        )

    def work() -> None:
        idle = project.work is None and project.set.model is not None
        show_it.disabled = export.disabled = not idle

    def uncover(_: Any) -> None:
        hidden = hidden_in(project.set.folder) if project.set.folder is not None else None
        items = "".join(f"<li>{escape(one)}</li>" for one in hidden or ["nothing at all"])
        truth.object = f"<h3>Hidden in this bench</h3><ul>{items}</ul>"

    show_it.on_click(display)
    export.on_click(exported)
    reveal.on_click(uncover)
    wipe.param.watch(lambda event: pictures.wipe(event.new / 100), "value")
    where.param.watch(lambda event: other.param.update(visible=event.new in (OTHER, RECORDED)), "value")
    visit.on("gain", show)
    visit.on("job model", work)
    return pn.Column(
        pn.Column(
            pn.pane.HTML("<h2>What is gained</h2>", margin=0),
            pn.FlexBox(
                picture, colour, plane, where, other, show_it, wipe, gap="10px", align_items="flex-end"
            ),
            words,
            place,
            css_classes=["card"],
            sizing_mode="stretch_width",
        ),
        pn.Column(
            pn.pane.HTML(
                "<h2>Give it to the headset</h2><p class='quiet'>A bundle holds the light path of the explained model "
                "as arrays; the headset needs neither this page nor captures.</p>",
                margin=0,
            ),
            pn.FlexBox(out, export, reveal, gap="10px", align_items="flex-end"),
            truth,
            css_classes=["card"],
            sizing_mode="stretch_width",
        ),
        sizing_mode="stretch_width",
    )
