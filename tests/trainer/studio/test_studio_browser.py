"""The studio in a real browser, as a user would use it: Debian's Chromium, by Playwright."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import HTTPCookieProcessor, Request, build_opener

import numpy as np
import pytest

from firmware_iface.virtual import BenchDescription, VirtualHeadset, make_defect
from tests.trainer.studio.chromium import CHROMIUM, FLAGS, MISSING
from trainer.captures.acquire import acquire_captures
from trainer.captures.open_bench import nominal_bench
from trainer.cli import main

pytest.importorskip("panel", reason="the studio needs the extra 'studio'")
from trainer.studio.gain_tasks import GainPicture, keep

playwright = pytest.importorskip("playwright.sync_api", reason="browser tests need playwright (extra 'dev')")

ROOT = Path(__file__).resolve().parent.parent.parent.parent
TOKEN = "for-this-test-alone"
SLOW_MS = 90_000
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
OWN_EFFECT = """from trainer.effects import Panel, Parameter, effect


@effect(stage="panel", acts_on="display", parameters=[Parameter("depth", "1", scale=0.01)])
def my_depth(panel: Panel, depth) -> Panel:
    \"\"\"All light is brighter.\"\"\"
    {body}
"""
FOCUSED = """() => {
    let one = document.activeElement;
    while (one.shadowRoot) one = one.shadowRoot.activeElement;
    return one.textContent;
}"""

playwright.expect.set_options(timeout=SLOW_MS)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


class Studio:
    """A running studio."""

    def __init__(self, home: Path, *arguments: str) -> None:
        self.home = home
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        self.log = (home / "studio.log").open("w+")
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "tests.trainer.few_effects"),
                *("studio", *arguments, "--token", TOKEN, "--no-browser"),
            ],
            cwd=home,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=self.log,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert "The studio is at http://127.0.0.1:" in line, line
        self.address = line.split()[-1]
        self.base = self.address.split("?")[0]

    def end(self) -> int:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(20)
        self.log.close()
        return code


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one capture set of a small simulated bench, with a leak at the panel."""
    folder = tmp_path_factory.mktemp("home")
    bench = BenchDescription("small", defects=(make_defect("zero_order"),)).resized(64, 96, 8.0)
    headset = VirtualHeadset(bench, 1)
    acquire_captures(headset, nominal_bench(headset), folder / "leaking", 7)
    return folder


@pytest.fixture(scope="module")
def studio(home: Path) -> Iterator[Studio]:
    one = Studio(home, "leaking")
    yield one
    one.end()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        one = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield one
        one.close()


def opened(browser: Any, address: str) -> Any:
    """A page of a browser of its own; what it asks of other machines fails the test."""
    page = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
    page.set_default_timeout(SLOW_MS)
    page.foreign = []
    page.on(
        "request",
        lambda r: (
            page.foreign.append(r.url)
            if not r.url.startswith(("http://127.0.0.1", "data:", "blob:"))
            else None
        ),
    )
    page.goto(address)
    return page


def button(page: Any, name: str) -> Any:
    return page.get_by_role("button", name=name, exact=True)


def idle(page: Any) -> None:
    """Wait until no work is under way."""
    playwright.expect(button(page, "Diagnose")).to_be_enabled(timeout=SLOW_MS)


def verdict(page: Any, words: str) -> None:
    playwright.expect(page.get_by_role("status").filter(has_text=words)).to_be_visible(timeout=SLOW_MS)


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
