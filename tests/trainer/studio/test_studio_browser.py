"""The studio in a real browser, as a user would use it: Debian's Chromium, by Playwright."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import HTTPCookieProcessor, Request, build_opener

import numpy as np
import pytest

from tests.trainer.studio.chromium import CHROMIUM, MISSING
from tests.trainer.studio.studio_pages import (
    SLOW_MS,
    TOKEN,
    Studio,
    button,
    idle,
    opened,
    playwright,
    verdict,
)
from trainer.cli import main
from trainer.studio.gain_tasks import GainPicture, keep

HEADSET = """schema = 1
bundle = "bundle"
[panel]
kind = "board"
bus = "virtual:/nowhere/headset.sock"
[lasers]
bus = "virtual:/nowhere/headset.sock"
power = { green = 0.5 }
channel = [
  { name = "green", wavelength_nm = 520.0, full_power_uw = 100.0, threshold_ma = 40.0, slope_uw_per_ma = 4.0 },
]
[camera]
kind = "virtual"
bus = "virtual:/nowhere/headset.sock"
"""
FOCUSED = """() => {
    let one = document.activeElement;
    while (one.shadowRoot) one = one.shadowRoot.activeElement;
    return one.textContent;
}"""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


def test_the_whole_way_and_a_second_browser_and_a_reload(browser: Any, studio: Studio) -> None:
    page = opened(browser, studio.address)
    assert "token" not in page.url
    verdict(page, "times the camera's noise")
    playwright.expect(page.get_by_text("nothing is wrong with them")).to_be_visible()
    second = opened(browser, studio.address)
    verdict(second, "times the camera's noise")

    button(page, "Diagnose").click()
    playwright.expect(button(second, "Cancel")).to_be_enabled()
    playwright.expect(button(second, "Diagnose")).to_be_disabled()
    verdict(page, "zero_order is missing")
    verdict(second, "zero_order is missing")
    playwright.expect(page.get_by_text("% of what is left").first).to_be_visible()
    playwright.expect(page.get_by_alt_text("What zero order would add to the prediction")).to_be_visible()
    idle(page)

    button(page, "Add zero_order").click()
    verdict(page, "Nothing is missing")
    verdict(second, "Nothing is missing")
    assert "zero_order" in (studio.home / "leaking-model.toml").read_text()
    ladder = page.locator("svg").filter(has_text="camera noise")
    playwright.expect(ladder.filter(has_text="+ zero order")).to_be_visible()

    page.reload()
    verdict(page, "Nothing is missing")
    button(page, "Undo").click()
    verdict(second, "times the camera's noise")
    playwright.expect(button(page, "Undo")).to_be_disabled()
    button(page, "Redo").click()
    playwright.expect(page.locator("svg").filter(has_text="+ zero order")).to_be_visible()
    button(page, "Compare").click()
    playwright.expect(page.get_by_role("heading", name="Predicted by the other")).to_be_visible()
    button(page, "Compare no more").click()
    assert not page.foreign and not second.foreign
    for one in (page, second):
        one.context.close()


def under(page: Any, heading: str, right: float, down: float) -> None:
    """Click into the plot below a heading, at a place in pixels from the heading's corner."""
    one = page.get_by_role("heading", name=heading).first
    one.evaluate("element => element.scrollIntoView({block: 'start'})")
    page.wait_for_timeout(300)
    box = one.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + right, box["y"] + box["height"] + down)


def test_a_click_on_a_place_or_a_band_lists_the_captures_that_are_worst_there(
    browser: Any, studio: Studio
) -> None:
    page = opened(browser, studio.address)
    playwright.expect(page.get_by_text("Worst over everything")).to_be_visible()
    page.wait_for_timeout(500)
    under(page, "Over the field", 100, 60)
    playwright.expect(page.get_by_text("Worst around row")).to_be_visible()
    under(page, "Over spatial frequency", 200, 110)
    playwright.expect(page.get_by_text("cycles/pixel (click one to see it)")).to_be_visible()
    worst = page.get_by_role("button").filter(has_text=": ")
    assert worst.count() >= 1
    name = worst.first.inner_text().split(":")[0].strip()
    worst.first.click()
    playwright.expect(page.get_by_text(f"Capture {name},")).to_be_visible()
    page.context.close()


def test_an_earlier_step_is_compared_with_the_present_model(browser: Any, home: Path, studio: Studio) -> None:
    page = opened(browser, studio.address)
    idle(page)
    ladder = page.locator("svg").filter(has_text="+ zero order")
    if not ladder.count():
        button(page, "Add zero_order").click() if button(page, "Add zero_order").count() else button(
            page, "Explain"
        ).click()
        playwright.expect(ladder).to_be_visible()
        idle(page)
    for _ in range(8):  # a click on a page that is just being drawn anew may be lost
        with suppress(playwright.TimeoutError):
            button(page, "Compare").click(timeout=5000)
        with suppress(playwright.TimeoutError):
            page.get_by_label("Second model").wait_for(timeout=15_000)
            break
    page.get_by_label("Second model").select_option("step 0")
    playwright.expect(page.get_by_text("next to step 0")).to_be_visible()
    playwright.expect(page.get_by_role("heading", name="Measured − the other")).to_be_visible()
    button(page, "Compare no more").click()
    playwright.expect(page.get_by_text("next to step 0")).to_have_count(0)
    page.context.close()


def test_a_recorded_gain_is_shown_and_a_headset_that_does_not_answer_is_a_sentence(
    browser: Any, home: Path, studio: Studio
) -> None:
    light = np.random.default_rng(1).random((64, 96)).astype(np.float32)
    kept = GainPicture("coffee", "green", "a bench of last week", light, light, light, 17.5, 31.25)
    keep(kept, home / "kept.npz")
    (home / "headset.toml").write_text(HEADSET)
    page = opened(browser, studio.address)
    idle(page)
    button(page, "Gain").click()
    where, file = page.get_by_label("Displayed by"), page.get_by_label("virtual:NAME, or a file")
    where.select_option("recorded: a file that was kept")
    file.fill(str(home / "kept.npz"))
    button(page, "Show the gain").click()
    playwright.expect(page.get_by_text("displayed by a bench of last week")).to_be_visible()
    playwright.expect(page.get_by_text("31.2 dB")).to_be_visible()
    where.select_option("a bench or headset, by its name or file")
    file.fill(str(home / "headset.toml"))
    button(page, "Show the gain").click()
    verdict(page, "there is no emulated hardware at virtual:/nowhere/headset.sock")
    assert "Traceback" not in page.content()
    page.context.close()


def test_everything_works_from_the_keyboard_and_at_twice_the_size(browser: Any, studio: Studio) -> None:
    page = opened(browser, studio.address)
    idle(page)
    for name in ("Diagnose", "Explain", "Compare", "Bench", "No name fits", "Gain", "Catalogue"):
        one = button(page, name)
        one.focus()
        assert page.evaluate(FOCUSED).strip() == name
    button(page, "Gain").press("Enter")
    playwright.expect(button(page, "Export")).to_be_visible()
    button(page, "No name fits").press(" ")
    playwright.expect(button(page, "Write the effect file")).to_be_visible()
    button(page, "Bench").press("Enter")
    page.set_viewport_size({"width": 640, "height": 400})  # what 200 % leaves of 1280 x 800
    page.wait_for_timeout(500)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth + 1")
    playwright.expect(button(page, "Diagnose")).to_be_visible()
    page.context.close()


def test_without_the_token_or_from_elsewhere_it_is_refused(studio: Studio) -> None:
    def answer(path: str, **headers: str) -> tuple[int, str]:
        opener = build_opener(HTTPCookieProcessor())
        try:
            with opener.open(Request(studio.base + path, headers=headers), timeout=20) as found:
                return found.status, found.read().decode()
        except HTTPError as error:
            return error.code, error.read().decode()

    for path in ("", "?token=wrong", "?token="):
        status, text = answer(path)
        assert status == 403 and "needs the token" in text and "Traceback" not in text
    assert answer(f"?token={TOKEN}")[0] == 200
    status, text = answer(f"?token={TOKEN}", Host="evil.example")
    assert status == 403 and "127.0.0.1" in text
    status, _ = answer("", Cookie="hololoop_studio=wrong")
    assert status == 403


def test_a_websocket_of_a_foreign_origin_is_refused(studio: Studio) -> None:
    from tornado.httpclient import HTTPClientError, HTTPRequest
    from tornado.websocket import websocket_connect

    address = studio.base.replace("http", "ws") + "ws"
    port = studio.base.rstrip("/").rsplit(":", 1)[1]
    cookie = f"hololoop_studio_{port}={TOKEN}"

    async def code(**headers: str) -> int:
        try:
            connection = await websocket_connect(
                HTTPRequest(address, headers=headers), subprotocols=["bokeh", "none"]
            )
        except HTTPClientError as error:
            return int(error.code)
        message = await connection.read_message()
        return 101 if message is not None else 403

    with ThreadPoolExecutor(1) as thread:  # the browser's driver runs a loop in this one
        for headers in (
            {"Origin": "http://evil.example", "Cookie": cookie},
            {"Origin": studio.base.rstrip("/")},
        ):
            assert thread.submit(lambda headers=headers: asyncio.run(code(**headers))).result() == 403


def test_without_captures_a_simulated_bench_is_captured_live(browser: Any, tmp_path: Path) -> None:
    studio = Studio(tmp_path)
    try:
        page = opened(browser, studio.address)
        page.get_by_label("Path of a folder").fill(str(tmp_path / "nowhere"))
        button(page, "Open").click()
        verdict(page, "is not a folder")
        button(page, "Capture").click()
        playwright.expect(page.get_by_role("heading", name="Ladder of errors")).to_be_visible(timeout=SLOW_MS)
        assert list(tmp_path.glob("guess-*/captures.csv"))
        button(page, "Gain").click()
        button(page, "Reveal what is hidden").click()
        playwright.expect(page.get_by_role("heading", name="Hidden in this bench")).to_be_visible()
        page.context.close()
    finally:
        began = time.monotonic()
        assert studio.end() in (0, 130)
        assert time.monotonic() - began < 15


def test_a_port_in_use_and_no_folder_are_sentences(
    studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    port = studio.base.rstrip("/").rsplit(":", 1)[1]
    for arguments, said in ((["--port", port], "cannot be used"), (["nowhere"], "is not a folder")):
        assert main(["studio", *arguments, "--no-browser"]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1
