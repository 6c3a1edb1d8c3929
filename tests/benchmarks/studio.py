"""How quick the studio is, in a real browser: first view, zoom at full size, a slider of the catalogue.

    python -m tests.benchmarks.studio [--json] [--keep FOLDER]

Two sets of a simulated bench are captured first (minutes; `--keep` keeps them for the next time): 24 captures of
240 x 320, and 6 of 1080 x 1920. All times end when the browser has painted what was asked for.

    command      from starting `hololoop-trainer studio` to the measured picture on the screen
    first view   from opening the page of a running studio, nothing in the browser's cache, to the same
    again        the same in a second tab
    capture      another capture chosen, whose prediction exists: its pictures
    zoom         a turn of the wheel at 1080 x 1920: pixels that fit the new view (the old ones scale at once)
    slider       a key press on a slider of the catalogue: the new picture
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

from firmware_iface.virtual import BenchDescription, VirtualHeadset, make_defect
from tests.trainer.studio.chromium import CHROMIUM, FLAGS, MISSING
from trainer.captures.acquire import acquire_captures
from trainer.captures.open_bench import nominal_bench

SETS = {"small": ((240, 320), 24), "large": ((1080, 1920), 6)}
TURNS = 12
# Notes the time of each paint after a data source with the column has changed.
WATCH = """column => {
    window.painted = [];
    for (const kind of ['wheel', 'keydown', 'input'])
        addEventListener(kind, event => window.asked = event.timeStamp, true);
    const seen = new Set();
    const look = () => {
        const documents = window.Bokeh ? Bokeh.documents : [];
        for (const one of documents) for (const model of one._all_models.values()) {
            if (seen.has(model) || model.type !== 'ColumnDataSource') continue;
            const held = model.data;
            const shape = (held.get ? held.get(column) : held[column])?.[0]?.shape;
            if (!shape) continue;
            seen.add(model);
            const note = () => requestAnimationFrame(() => setTimeout(() => window.painted.push(performance.now())));
            model.properties.data.change.connect(note);
            if (shape[0] > 2) note();
        }
        if (seen.size === 0) setTimeout(look, 5);
    };
    look();
}"""


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="numbers for a program")
    parser.add_argument("--keep", type=Path, help="where the capture sets are kept")
    options = parser.parse_args()
    if CHROMIUM is None:
        sys.exit(MISSING)
    with tempfile.TemporaryDirectory() as folder:
        home = options.keep or Path(folder)
        home.mkdir(exist_ok=True)
        for name, (shape, count) in SETS.items():
            _capture(home / name, shape, count)
        found = _measured(home)
    if options.json:
        print(json.dumps(found))
        return
    print(f"{'ms':12s} {'median':>8s} {'most':>8s}  of")
    for name, times in found.items():
        print(f"{name:12s} {statistics.median(times):8.0f} {max(times):8.0f}  {len(times)}")


def _capture(folder: Path, shape: tuple[int, int], count: int) -> None:
    if (folder / "captures.csv").exists():
        return
    bench = BenchDescription("bench", defects=(make_defect("zero_order"),)).resized(*shape, 8.0)
    headset = VirtualHeadset(bench, 1)
    acquire_captures(headset, nominal_bench(headset), folder, count)


def _measured(home: Path) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)

        def visit(address: str, context: Any = None) -> Any:
            page = (context or browser.new_context(viewport={"width": 1280, "height": 800})).new_page()
            page.add_init_script(f"({WATCH})('measured')")
            page.goto(address, wait_until="commit")
            page.wait_for_function("window.painted.length > 0")
            return page

        for _ in range(3):
            start = time.perf_counter()
            with _studio(home, "small") as address:
                page = visit(address)
                found.setdefault("command", []).append(1e3 * (time.perf_counter() - start))
                page.close()
        with _studio(home, "small") as address:
            time.sleep(5)  # its processes are ready, as when a person copies the address
            for _ in range(3):
                page = visit(address)
                found.setdefault("first view", []).append(page.evaluate("window.painted[0]"))
                again = visit(address, page.context)
                found.setdefault("again", []).append(again.evaluate("window.painted[0]"))
                again.close()
                page.close()
            found["slider"] = _slider(visit(address))
        with _studio(home, "large") as address:
            page = visit(address)
            done = "option => option.every(o => !o.text.includes('held out') || o.text.includes('excess'))"
            options = page.get_by_label("Capture", exact=True).locator("option")
            while not options.evaluate_all(done):
                time.sleep(1)
            found["capture"] = _captures(page)
            found["zoom"] = _zoom(page)
        browser.close()
    return found


def _captures(page: Any) -> list[float]:
    chooser = page.get_by_label("Capture", exact=True)
    times = []
    for _ in range(TURNS):
        page.wait_for_timeout(400)
        options = chooser.locator("option").all()
        held = [k for k, one in enumerate(options) if "held out" in one.inner_text()]
        now = chooser.evaluate("one => one.selectedIndex")
        chooser.select_option(index=next((k for k in held if k > now), held[0]))
        times.append(_next(page))
    return times


def _zoom(page: Any) -> list[float]:
    plot = page.locator(".bk-Figure").first
    plot.scroll_into_view_if_needed()
    picture = plot.bounding_box()
    page.mouse.move(picture["x"] + 0.4 * picture["width"], picture["y"] + 0.5 * picture["height"])
    times = []
    for turn in range(TURNS):
        page.wait_for_timeout(600)
        page.mouse.wheel(0, -240 if turn < TURNS // 2 else 240)
        times.append(_next(page))
    return times


def _slider(page: Any) -> list[float]:
    page.get_by_role("button", name="Catalogue").click()
    page.get_by_role("slider").first.wait_for()
    page.wait_for_timeout(2000)
    page.evaluate(f"({WATCH})('with_effect')")
    slider = page.get_by_role("slider").first
    slider.focus()
    times = []
    for _ in range(2 * TURNS):
        page.wait_for_timeout(300)
        page.keyboard.press("ArrowRight")
        times.append(_next(page))
    return times


def _next(page: Any) -> float:
    """From the last key, turn or choice to the next paint."""
    page.wait_for_function("window.painted.some(t => t > window.asked)", timeout=10_000)
    return float(page.evaluate("window.painted.find(t => t > window.asked) - window.asked"))


@contextmanager
def _studio(home: Path, captures: str) -> Iterator[str]:
    """A running studio, and its address."""
    command = [sys.executable, "-m", "trainer.cli", "studio", str(home / captures), "--no-browser"]
    command += ["--model", str(home / "model.toml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ)) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[-1]
        finally:
            process.terminate()


if __name__ == "__main__":
    main()
