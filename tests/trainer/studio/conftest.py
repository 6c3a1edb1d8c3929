"""What the studio's tests share: a folder with captures, a studio that shows them, and a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.trainer.studio.chromium import CHROMIUM, FLAGS

if TYPE_CHECKING:
    from tests.trainer.studio.studio_pages import Studio
    from trainer.captures.capture_set import CaptureSet


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one capture set."""
    from tests.trainer.studio.studio_pages import leaking_captures

    folder = tmp_path_factory.mktemp("home")
    leaking_captures(folder / "leaking")
    return folder


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    """A small set with a leak at the panel, for tests without a browser."""
    from trainer.effects.effect_catalogue import catalogue
    from trainer.effects.testing import captures_with

    folder = tmp_path_factory.mktemp("studio") / "leaking"
    return captures_with(folder, catalogue()["zero_order"], {"leak_real": 0.2}, patterns=6)


@pytest.fixture(scope="module")
def studio(home: Path) -> Iterator[Studio]:
    """A studio that shows them."""
    from tests.trainer.studio.studio_pages import Studio

    one = Studio(home, "leaking")
    yield one
    one.end()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Without anything kept from before."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="browser tests need playwright (extra 'dev')"
    )
    with playwright.sync_playwright() as driver:
        one = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield one
        one.close()
