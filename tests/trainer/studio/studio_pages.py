"""A running studio, and pages of it in a real browser, for tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.virtual import BenchDescription, VirtualHeadset, make_defect
from trainer.captures.acquire import acquire_captures
from trainer.captures.open_bench import nominal_bench

pytest.importorskip("panel", reason="the studio needs the extra 'studio'")
playwright = pytest.importorskip("playwright.sync_api", reason="browser tests need playwright (extra 'dev')")

ROOT = Path(__file__).resolve().parent.parent.parent.parent
TOKEN = "for-this-test-alone"
SLOW_MS = 90_000

playwright.expect.set_options(timeout=SLOW_MS)


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


def leaking_captures(folder: Path) -> None:
    """Write one capture set of a small simulated bench, with a leak at the panel."""
    bench = BenchDescription("small", defects=(make_defect("zero_order"),)).resized(64, 96, 8.0)
    headset = VirtualHeadset(bench, 1)
    acquire_captures(headset, nominal_bench(headset), folder, 7)


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
