"""The catalogue: every effect with its formula, its parameters as sliders, and a picture that moves with them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from typing import Any

import panel as pn
from bokeh.models.widgets.markups import Div

from firmware_iface.errors import InputError
from trainer.effects.definition import STAGES, Effect
from trainer.effects.effect_catalogue import Catalogue
from trainer.studio.effect_demonstration import (
    CAPTURES,
    EffectNumber,
    EffectPicture,
    demonstrate,
    differs_by_capture,
    numbers_of,
    orders_of,
)
from trainer.studio.effect_pictures import EffectPictures
from trainer.studio.formula_svg import formula_svg
from trainer.studio.labelled_slider import LabelledSlider

FIRST = "zero_order"
PERIOD_MS = 80  # between two pictures of a sweep
SWEEP_STEPS = 50  # pictures from the lowest to the highest value and back
_SLIDER = {"flex": "1 1 190px", "max-width": "300px"}
LIGHT_PATH = ("gray level", "drive", "panel", "pupil", "|·|²", "sensor", "camera counts")


def catalogue_view(catalogue: Catalogue) -> pn.viewable.Viewable:
    """Every effect of a catalogue: what it is, its formula, and what it does to a test picture.

    Parameters
    ----------
    catalogue : dict of str to Effect
        A user's own effects included.

    Returns
    -------
    panel Viewable
    """
    return _CatalogueView(catalogue).view


class _CatalogueView:
    """The widgets of one visitor, and what they change."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._numbers: tuple[EffectNumber, ...] = ()
        self._sliders: list[LabelledSlider] = []
        self._quiet = False
        self._redraw_is_due = False
        self._step = 0
        self._player: Any = None

        start = FIRST if FIRST in catalogue else next(iter(catalogue))
        self._effect = pn.widgets.Select(
            label="Effect", value=start, size=len(catalogue) + len(STAGES) - 2, margin=0,
            sizing_mode="stretch_width", stylesheets=[_LIST_STYLE], **_choices(catalogue),
        )  # fmt: skip
        self._order = pn.widgets.Select(label="Order of the map", options=[0], width=120, margin=0)
        self._seen_by = pn.widgets.Select(
            label="Seen by", options={"the camera": False, "the eye": True}, width=120, margin=0
        )
        self._capture = LabelledSlider(
            value=1, label="capture", about="Each capture has a gain of its own.", low=1, high=CAPTURES, step=1,
            styles=_SLIDER, margin=0,
        )  # fmt: skip
        self._sweep = pn.widgets.Select(label="Moved by Play", options=[""], width=190, margin=0)
        self._play = pn.widgets.Toggle(label="Play", color="primary", width=90, margin=0)
        self._example = pn.widgets.Button(label="Example", width=90, margin=0)
        self._none = pn.widgets.Button(label="No effect", width=90, margin=0)
        self._whole = pn.widgets.Button(label="Whole picture", width=110, margin=0)
        self._words = _html("")
        # A plain bokeh model: a panel pane takes several times as long to change as the picture takes to compute.
        self._figures = Div(sizing_mode="stretch_width", stylesheets=[_WORDS_STYLE], margin=0)
        self._fault = _html("")
        self._fault.visible = False
        self._slider_box = pn.FlexBox(
            flex_wrap="wrap", gap="10px 24px", sizing_mode="stretch_width", margin=0
        )
        one = catalogue[start]
        numbers = numbers_of(one, orders_of(one)[0])
        self._pictures = EffectPictures(demonstrate(one, [n.absent for n in numbers], orders_of(one)[0]))

        self._effect.param.watch(self._choose, "value")
        self._order.param.watch(self._change_order, "value")
        self._seen_by.param.watch(self._changed, "value")
        self._capture.param.watch(self._changed, "value")
        self._play.param.watch(self._start_or_stop, "value")
        self._example.on_click(lambda _: self._set([n.example for n in self._numbers]))
        self._none.on_click(lambda _: self._set([n.absent for n in self._numbers]))
        self._whole.on_click(lambda _: self._pictures.show_whole())

        controls = pn.FlexBox(
            self._play, self._sweep, self._example, self._none, self._seen_by, self._order, self._whole,
            align_items="end", flex_wrap="wrap", gap="8px 12px", sizing_mode="stretch_width", margin=0,
        )  # fmt: skip
        main = pn.Column(
            self._words, self._fault, self._pictures.view, pn.pane.Bokeh(self._figures, margin=0),
            controls, self._slider_box,
            styles={"flex": "999 1 480px", "min-width": "0", "gap": "14px"}, margin=0,
        )  # fmt: skip
        side = pn.Column(self._effect, styles={"flex": "1 1 215px", "max-width": "100%"}, margin=0)
        self.view = pn.FlexBox(
            side, main, flex_wrap="wrap", align_items="start", gap="20px", sizing_mode="stretch_width",
            css_classes=["catalogue"], margin=12,
        )  # fmt: skip
        self._choose()

    @property
    def _chosen(self) -> Effect:
        return self._catalogue[self._effect.value]

    def _choose(self, *_: Any) -> None:
        """Another effect: its words, its sliders at an example, its picture."""
        self._play.value = False
        effect = self._chosen
        with self._silence():
            self._words.object = effect_words(effect)
            orders = orders_of(effect)
            self._order.param.update(options=list(orders), value=orders[0])
            self._order.visible = len(orders) > 1
        self._change_order()

    def _change_order(self, *_: Any) -> None:
        """New sliders; numbers of the same name keep their values."""
        if self._quiet:
            return
        effect = self._chosen
        before = {(effect.name, n.label): s.value for n, s in zip(self._numbers, self._sliders, strict=True)}
        self._say("")
        self._numbers, by_capture = (), False
        try:
            self._numbers = numbers_of(effect, self._order.value)
            by_capture = differs_by_capture(effect)
        except InputError as error:  # at its example; its sliders may lead to where it works
            self._say(str(error))
        same = self._shown == effect.name
        self._shown = effect.name
        with self._silence():
            self._sliders = [
                LabelledSlider(
                    value=before.get((effect.name, n.label), n.example) if same else n.example,
                    label=n.label, about=n.about, low=n.low, high=n.high, step=n.step,
                    styles=_SLIDER, margin=0,
                )
                for n in self._numbers
            ]  # fmt: skip
            for slider in self._sliders:
                slider.param.watch(self._changed, "value")
            moved = [*self._sliders, self._capture] if by_capture else self._sliders
            self._slider_box.objects = moved
            first = next((k for k, n in enumerate(self._numbers) if n.example != n.absent), 0)
            names = {s.label: k for k, s in enumerate(moved)}
            self._sweep.param.update(options=names, value=len(moved) - 1 if by_capture else first)
        if not same:
            self._pictures.name(effect.name)
        self._redraw()

    _shown = ""

    def _set(self, values: list[float]) -> None:
        self._play.value = False
        with self._silence():
            for slider, value in zip(self._sliders, values, strict=True):
                slider.value = value
        self._redraw()

    def _changed(self, *_: Any) -> None:
        """Redraw once for all changes that have arrived by then."""
        if self._quiet or self._redraw_is_due:
            return
        document = pn.state.curdoc
        if document is None or document.session_context is None:
            self._redraw()
            return
        self._redraw_is_due = True
        document.add_next_tick_callback(self._redraw)

    def _redraw(self) -> None:
        self._redraw_is_due = False
        if not self._numbers:
            return
        try:
            picture = demonstrate(
                self._chosen,
                [s.value for s in self._sliders],
                self._order.value,
                by_eye=self._seen_by.value,
                capture=round(self._capture.value) - 1,
            )
        except InputError as error:
            self._say(str(error))
            return
        self._say("")
        with pn.io.hold():  # one message, not one for each change
            self._pictures.draw(picture)
            self._figures.text = picture_figures(picture)

    def _say(self, fault: str) -> None:
        """Show what went wrong with a user's effect; nothing for ""."""
        text = f'<p role="alert" class="fault">{escape(fault)}</p>' if fault else ""
        if self._fault.object != text:
            self._fault.param.update(object=text, visible=bool(fault))

    def _start_or_stop(self, *_: Any) -> None:
        self._play.label = "Pause" if self._play.value else "Play"
        if self._play.value:
            self._step = 0
            self._player = pn.state.add_periodic_callback(self._move, period=PERIOD_MS)
        elif self._player is not None:
            self._player.stop()
            self._player = None

    def _move(self) -> None:
        """One step of the sweep: from the lowest value to the highest and back."""
        slider = self._slider_box.objects[self._sweep.value]
        self._step += 1
        if slider is self._capture:
            slider.value = 1 + self._step // 4 % CAPTURES
            return
        share = (1 - math.cos(2 * math.pi * self._step / SWEEP_STEPS)) / 2
        slider.value = float(f"{slider.low + share * (slider.high - slider.low):.3g}")

    @contextmanager
    def _silence(self) -> Iterator[None]:
        """A block in which widgets change without a redraw."""
        before, self._quiet = self._quiet, True
        try:
            yield
        finally:
            self._quiet = before


def effect_words(effect: Effect) -> str:
    """What an effect is, as HTML: stage, what it acts on, formula, description and references."""
    steps = "".join(
        f"<li><span{' class=here aria-current=step' if step == effect.stage else ''}>{escape(step)}</span></li>"
        for step in LIGHT_PATH
    )
    acts_on = (
        "Acts on the display: the eye sees it, and patterns correct for it."
        if effect.acts_on == "display"
        else "Acts on the camera alone: the eye does not see it, and no pattern corrects for it."
    )
    own = "" if effect.source == "built in" else f" Defined in {escape(effect.source)}."
    formula = f'<div class="formula-box">{formula_svg(effect.formula)}</div>' if effect.formula else ""
    description = f"<p>{escape(effect.description)}</p>" if effect.description else ""
    sources = "".join(f"<li>{escape(r)}</li>" for r in effect.references)
    cited = f'<ul class="sources" aria-label="References">{sources}</ul>' if sources else ""
    return (
        f'<div class="head"><h2>{escape(effect.name)}</h2>'
        f'<ol class="place" aria-label="Light path, this effect\'s stage marked">{steps}</ol></div>'
        f'<div class="what"><div class="text"><p class="about">{escape(effect.about)}</p>{description}'
        f'<p class="acts">{acts_on}{own}</p></div>{formula}</div>{cited}'
    )


def picture_figures(picture: EffectPicture) -> str:
    """The numbers of a picture, as HTML."""
    rows = (
        ("nrmse", f"{picture.nrmse:.3f}", "rms difference over contrast"),
        ("excess", f"{picture.excess:.4f}", "its square"),
        ("light", f"{100 * picture.light:.1f} %", "of the ideal picture"),
    )
    cells = "".join(
        f"<div><dt>{name}</dt><dd><b>{value}</b> <span>{about}</span></dd></div>"
        for name, value, about in rows
    )
    return f'<dl class="numbers">{cells}</dl>'


def _choices(catalogue: Catalogue) -> dict[str, Any]:
    """Options of the list of effects: a line that cannot be chosen for each stage, its effects under it."""
    options: dict[str, str] = {}
    for stage in STAGES:
        options[stage.upper()] = f"stage {stage}"
        for effect in catalogue.values():
            if effect.stage == stage:
                own = "" if effect.source == "built in" else " (own)"
                options["\u2003" + effect.name + own] = effect.name
    return {"options": options, "disabled_options": [f"stage {stage}" for stage in STAGES]}


def _html(text: str) -> pn.pane.HTML:
    return pn.pane.HTML(text, sizing_mode="stretch_width", margin=0, stylesheets=[_WORDS_STYLE])


_LIST_STYLE = """
select { height: auto; overflow-y: auto; font: inherit; padding: 6px; border-radius: 6px; }
@media (max-width: 800px) { select { height: 7.5em; } }
option { padding: 3px 6px; border-radius: 4px; }
option:disabled { font-size: 0.78em; letter-spacing: 0.08em; padding-top: 9px; }
"""
_WORDS_STYLE = """
.head { display: flex; flex-wrap: wrap; align-items: center; justify-content: space-between; gap: 6px 20px; }
h2 { font-size: 1.35rem; margin: 0; font-weight: 650; }
.place { display: flex; flex-wrap: wrap; list-style: none; margin: 0; padding: 0; font-size: 0.85rem; gap: 4px 0; }
.place span { padding: 2px 8px; border-radius: 999px; opacity: 0.8; }
.place li + li::before { content: "→"; opacity: 0.5; }
.place .here { opacity: 1; font-weight: 650; background: #20639b; color: #fff; }
.what { display: flex; flex-wrap: wrap; gap: 8px 28px; align-items: center; margin-top: 8px; }
.text { flex: 1 1 380px; max-width: 105ch; }
.formula-box { flex: 0 1 auto; margin-left: auto; padding: 10px 18px; border-radius: 8px; font-size: 1.05rem;
  max-width: 100%; box-sizing: border-box; overflow-x: auto;
  background: color-mix(in srgb, currentColor 6%, transparent); }
p { margin: 0 0 4px; line-height: 1.45; font-size: 0.92rem; }
.about { font-weight: 600; }
.acts { opacity: 0.85; }
.sources { margin: 4px 0 0; padding: 0; list-style: none; font-size: 0.8rem; opacity: 0.8; line-height: 1.4; }
.numbers { display: flex; flex-wrap: wrap; gap: 4px 32px; margin: 0; }
.numbers div { display: flex; gap: 8px; align-items: baseline; }
.numbers dt { opacity: 0.8; }
.numbers dd { margin: 0; font-variant-numeric: tabular-nums; }
.numbers b { font-size: 1.15rem; }
.numbers span { font-size: 0.8rem; opacity: 0.75; }
.fault { border-left: 4px solid #d9822b; padding: 6px 12px; }
"""
