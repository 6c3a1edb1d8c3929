"""The demo: what it leaves behind, and that the display gets better by what was found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from firmware_iface.errors import InputError
from runtime.solver import quality
from trainer.captures.capture_set import read_captures
from trainer.commands.demo import first_free
from trainer.cycle.demo_run import run_demo
from trainer.report.display_section import DisplayedPicture, display_section, with_display


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(InputError, match="not an empty folder"):
        run_demo(tmp_path)
    with pytest.raises(InputError, match="not an empty folder"):
        run_demo(tmp_path / "mine.txt")
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_the_display_is_at_the_end_of_the_reports_main_part() -> None:
    target = np.random.default_rng(0).random((12, 16))
    light = 3 * target**1.1
    shown = [DisplayedPicture("a <picture>", target, {"before": light}, {"before": quality(light, target)})]
    html = with_display("<main><p>x</p></main></body>", shown, "better & better")
    assert html.index("<p>x</p>") < html.index("<section>") < html.index("</main>")
    assert "better &amp; better" in html
    assert html.count("data:image/png;base64,") == 2
    assert "dB, nrmse" in html
    assert with_display("no main", shown, "") == "no main" + display_section(shown, "")


@pytest.mark.slow
def test_the_quick_demo(tmp_path: Path) -> None:
    shares: list[float] = []
    result = run_demo(tmp_path / "demo", quick=True, progress=lambda done, what: shares.append(done))
    assert set(result["found"]) == {"zero_order", "illumination", "phase_response"}
    assert result["verdict"] == "complete"
    display = {name: numbers["psnr_db"] for name, numbers in result["display"].items()}
    assert display["after"] > display["before"] + 8
    assert display["oracle"] > display["after"] - 0.5
    assert shares == sorted(shares) and shares[-1] == 1
    assert len(read_captures(Path(result["captures"]))) > 5
    page = Path(result["report"]).read_text(encoding="utf-8")
    assert "What the display shows" in page
    with Image.open(tmp_path / "demo" / "patterns" / "astronaut-after.png") as pattern:
        assert pattern.mode == "L"


def test_a_demo_after_a_demo_gets_a_folder_of_its_own(tmp_path: Path) -> None:
    wanted = tmp_path / "hololoop-demo"
    for name in ("hololoop-demo", "hololoop-demo-2", "hololoop-demo-3"):
        folder = first_free(wanted)
        assert folder == tmp_path / name
        folder.mkdir()
