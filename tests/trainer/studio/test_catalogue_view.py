"""The catalogue's page: every effect has its words and its formula, and a slider changes the picture in a browser."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.trainer.studio.chromium import CHROMIUM, FLAGS, MISSING
from trainer.effects import catalogue

pn = pytest.importorskip("panel", reason="panel is not installed: pip install hololoop[studio]")

from trainer.studio.catalogue_view import _CatalogueView, catalogue_view, effect_words  # noqa: E402
from trainer.studio.formula_svg import formula_svg  # noqa: E402

KNOWN = {name: one for name, one in catalogue().items() if one.source == "built in"}
MODELS = "[...Bokeh.documents[0]._all_models.values()]"
SOURCE = f"{MODELS}.find(m => m.type == 'ColumnDataSource' && 'difference' in m.data)"
LARGEST = f"() => Math.max(...Array.from({SOURCE}.data.difference[0], Math.abs))"


@pytest.mark.parametrize("name", KNOWN)
def test_each_effect_has_a_formula_that_can_be_set_and_its_words(name: str) -> None:
    one = KNOWN[name]
    assert one.formula and one.description
    assert formula_svg(one.formula).startswith("<svg")
    words = effect_words(one)
    assert one.name in words and "<svg" in words and "aria-current=step>" + one.stage in words


def test_a_formula_that_cannot_be_set_is_shown_as_it_is_written() -> None:
    assert formula_svg(r"\nonsense{<a>}") == r"<code>\nonsense{&lt;a&gt;}</code>"


def test_each_effect_can_be_chosen() -> None:
    view = catalogue_view(catalogue())
    chooser = next(w for w in view.select(pn.widgets.Select) if w.label == "Effect")
    for name in KNOWN:
        chooser.value = name
        assert any(f"With {name}" in str(pane.object) for pane in view.select(pn.pane.HTML))


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip(MISSING)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = pn.serve(
        lambda: catalogue_view(catalogue()), port=port, address="127.0.0.1", show=False, threaded=True,
        websocket_origin=f"127.0.0.1:{port}",
    )  # fmt: skip
    try:
        with api.sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            opened = browser.new_page(viewport={"width": 1280, "height": 800})
            requests: list[str] = []
            opened.on("request", lambda request: requests.append(request.url))
            for _ in range(40):  # until the server listens
                try:
                    opened.goto(f"http://127.0.0.1:{port}/")
                    break
                except api.Error:
                    time.sleep(0.25)
            opened.wait_for_selector("canvas")
            opened.get_by_role("slider", name="leak real").wait_for()
            yield opened
            outside = [
                u for u in requests if not u.startswith((f"http://127.0.0.1:{port}/", "data:", "blob:"))
            ]
            assert not outside, "the page needs nothing from the internet"
            browser.close()
    finally:
        server.stop()


def until(page: Any, condition: str) -> None:
    page.wait_for_function(condition, timeout=10_000)


def test_a_slider_changes_the_picture_from_the_keyboard(page: Any) -> None:
    page.get_by_role("button", name="No effect").click()
    until(page, f"() => ({LARGEST})() < 1")
    slider = page.get_by_role("slider", name="leak real")
    slider.focus()
    for _ in range(5):
        slider.press("ArrowRight")
    until(page, f"() => ({LARGEST})() > 10")
    page.get_by_role("spinbutton", name="leak real, as a number").fill("0")
    page.keyboard.press("Tab")
    until(page, f"() => ({LARGEST})() < 1")


def test_another_effect_brings_its_words_and_its_sliders(page: Any) -> None:
    page.get_by_label("Effect", exact=True).select_option("distance")
    page.get_by_role("slider", name="offset (mm)").wait_for()
    page.get_by_role("heading", name="distance", exact=True).wait_for()
    page.get_by_role("img", name="Formula").wait_for()
    until(page, f"() => ({LARGEST})() > 10")


def test_the_eye_does_not_see_what_the_camera_does(page: Any) -> None:
    page.get_by_label("Effect", exact=True).select_option("sensor_blur")
    page.get_by_role("heading", name="With sensor_blur").wait_for()
    until(page, f"() => ({LARGEST})() > 10")
    page.get_by_label("Seen by").select_option("the eye")
    until(page, f"() => ({LARGEST})() == 0")
    page.get_by_label("Seen by").select_option("the camera")


def test_play_moves_the_slider_until_it_is_paused(page: Any) -> None:
    page.get_by_label("Effect", exact=True).select_option("distance")
    slider = page.get_by_role("slider", name="offset (mm)")
    slider.wait_for()
    before = slider.input_value()
    page.get_by_role("button", name="Play").click()
    page.get_by_role("button", name="Pause").wait_for()
    deadline = time.monotonic() + 10
    while slider.input_value() == before and time.monotonic() < deadline:
        time.sleep(0.1)
    assert slider.input_value() != before
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Play").wait_for()


def test_an_effect_that_fails_at_some_values_is_a_sentence_beside_its_sliders(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from trainer.effects import Panel, Parameter, effect\n\n\n"
        '@effect(stage="panel", acts_on="display", parameters=[Parameter("depth", "1", scale=0.01)])\n'
        "def my_depth(panel: Panel, depth) -> Panel:\n"
        '    """All light is brighter."""\n'
        "    if float(depth) > 0.09:\n"
        "        raise ValueError('too deep')\n"
        "    return panel.multiplied(1 + depth)\n"
    )
    view = _CatalogueView(catalogue([file]))
    view._effect.value = "my_depth"
    assert 'role="alert"' in view._fault.object and "too deep" in view._fault.object
    assert "mine.py, line 8" in view._fault.object
    view._set([0.0])
    assert view._fault.object == ""
