"""What goes wrong in the studio, and what changes at a bad moment, as sentences in a real browser."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.trainer.studio.chromium import CHROMIUM, MISSING
from tests.trainer.studio.studio_pages import SLOW_MS, Studio, button, idle, opened, playwright, verdict

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
OWN_EFFECT = """from trainer.effects import Panel, Parameter, effect


@effect(stage="panel", acts_on="display", parameters=[Parameter("depth", "1", scale=0.01)])
def my_depth(panel: Panel, depth) -> Panel:
    \"\"\"All light is brighter.\"\"\"
    {body}
"""


def test_a_failing_effect_file_is_a_sentence_in_the_page(browser: Any, home: Path) -> None:
    file = home / "mine.py"
    file.write_text(OWN_EFFECT.format(body="return panel.multiplied(1 + depth)"))
    studio = Studio(home, "leaking", "--effects", "mine.py", "--model", "mine.toml")
    try:
        page = opened(browser, studio.address)
        button(page, "Catalogue").click()
        chooser = page.get_by_label("Effect", exact=True)
        chooser.select_option("my_depth")
        playwright.expect(page.get_by_role("heading", name="my_depth", exact=True)).to_be_visible()
        stages = page.get_by_role("list", name="Light path, this effect's stage marked").bounding_box()
        assert stages and stages["height"] < 60 < stages["width"], (
            "the stages stand in a line beside the name"
        )
        file.write_text(OWN_EFFECT.format(body="raise ValueError('no such depth')"))
        verdict(page, "no such depth")
        verdict(page, "mine.py, line 7")
        playwright.expect(chooser).to_be_visible()  # the catalogue stays as it was
        file.write_text(OWN_EFFECT.format(body="return ("))
        verdict(page, "mine.py")
        assert "Traceback" not in page.content()
        page.context.close()
    finally:
        assert studio.end() in (0, 130)


def test_work_is_cancelled_and_a_killed_worker_is_a_sentence(browser: Any, studio: Studio) -> None:
    page = opened(browser, studio.address)
    idle(page)
    path = studio.home / "leaking-model.toml"
    if path.exists() and "zero_order" in path.read_text():
        playwright.expect(button(page, "Undo")).to_be_enabled()
        button(page, "Undo").click()
    playwright.expect(page.locator("svg").filter(has_text="+ zero order")).to_have_count(0)
    verdict(page, "times the camera's noise")
    before = path.read_bytes() if path.exists() else b""
    button(page, "Explain").click()
    playwright.expect(button(page, "Cancel")).to_be_enabled()
    button(page, "Cancel").press("Enter")
    verdict(page, "Cancelled; the model is as it was.")
    idle(page)
    button(page, "Diagnose").click()
    playwright.expect(button(page, "Cancel")).to_be_enabled()
    children = Path(f"/proc/{studio.process.pid}/task/{studio.process.pid}/children").read_text().split()
    busiest = max(children, key=lambda pid: int(pid))  # the worker that was started last does the work
    for pid in {busiest, *children}:
        os.kill(int(pid), signal.SIGKILL)
    verdict(page, "has ended")
    assert "Traceback" not in page.content()
    after = path.read_bytes() if path.exists() else b""
    assert before == after
    idle(page)
    page.context.close()


def with_the_other_sign(home: Path, name: str) -> Path:
    """A copy of the capture set whose bench.toml has the phase's sign wrong; returns that file."""
    shutil.copytree(home / "leaking", home / name)
    bench = home / name / "bench.toml"
    text = bench.read_text()
    bench.write_text(
        text.replace("phase_sign = 1", "phase_sign = -1")
        if "phase_sign" in text
        else text.replace("[panel]", "[panel]\nphase_sign = -1")
    )
    return bench


def test_a_broken_set_is_shown_as_sentences_and_a_click_corrects_it(browser: Any, home: Path) -> None:
    bench = with_the_other_sign(home, "broken")
    studio = Studio(home, "broken")
    try:
        page = opened(browser, studio.address)
        fix = button(page, "Set phase_sign = 1 in bench.toml")
        fix.wait_for()
        playwright.expect(button(page, "Diagnose")).to_be_disabled()
        fix.click()
        verdict(page, "The old file is kept as bench.toml.before-1")
        playwright.expect(page.get_by_text("nothing is wrong with them")).to_be_visible()
        idle(page)
        bench.write_text("[panel\n")
        verdict(page, "bench.toml")
        assert "Traceback" not in page.content()
        page.context.close()
    finally:
        assert studio.end() in (0, 130)


def test_what_changes_before_a_page_is_drawn_is_shown_when_it_is(browser: Any, home: Path) -> None:
    """The server hears late that the second page has been drawn; until then the first one corrects the captures."""
    kept: list[tuple[Any, Any]] = []
    drawn: list[bool] = []

    def between(page_side: Any) -> None:
        server_side = page_side.connect_to_server()

        def to_server(message: Any) -> None:
            if drawn or not (kept or '"PATCH-DOC"' in str(message)):
                server_side.send(message)
            else:
                kept.append((server_side, message))

        page_side.on_message(to_server)

    with_the_other_sign(home, "drawn")
    studio = Studio(home, "drawn")
    try:
        first = opened(browser, studio.address)
        button(first, "Set phase_sign = 1 in bench.toml").wait_for()
        second = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
        second.set_default_timeout(SLOW_MS)
        second.route_web_socket(lambda _: True, between)
        second.goto(studio.address)
        button(second, "Set phase_sign = 1 in bench.toml").wait_for()
        button(first, "Set phase_sign = 1 in bench.toml").click()
        playwright.expect(first.get_by_text("nothing is wrong with them")).to_be_visible()
        idle(first)
        assert kept
        drawn.append(True)
        for server_side, message in kept:
            server_side.send(message)
        playwright.expect(second.get_by_text("nothing is wrong with them")).to_be_visible()
        idle(second)
        for one in (first, second):
            one.context.close()
    finally:
        assert studio.end() in (0, 130)
