"""The demo: what it leaves behind, and that the display gets better by what was found."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.virtual import load_bench, open_headset
from runtime.solver import quality
from trainer.captures.capture_set import read_captures
from trainer.captures.open_bench import nominal_bench
from trainer.commands.demo import first_free
from trainer.cycle import demo_run
from trainer.cycle.demo_pictures import target_of
from trainer.cycle.demo_run import (
    COLOUR,
    FULL_SIZE,
    QUICK,
    QUICK_COLOUR,
    USUAL,
    Demonstrated,
    Solved,
    on_hardware,
    run_demo,
)
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


def test_a_large_picture_is_shown_by_means_of_blocks() -> None:
    target = np.full((3, 600, 2000), 0.25)
    target[:, ::2] = 0.75
    light = {"after": target}
    shown = [DisplayedPicture("stripes", target, light, {"after": quality(target, target)})]
    html = display_section(shown, "")
    # of two pictures, in words and in their captions
    assert html.count("each point is the mean of 3 × 3 pixels") == 4
    encoded = html.partition("data:image/png;base64,")[2].partition('"')[0]
    with Image.open(io.BytesIO(base64.b64decode(encoded))) as picture:
        assert picture.size == (666, 200)


@pytest.mark.slow
@pytest.mark.usefixtures("real_time")
def test_the_quick_demo(tmp_path: Path) -> None:
    shares: list[float] = []
    result = run_demo(tmp_path / "demo", QUICK, progress=lambda done, what: shares.append(done))
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


IN_COLOUR = """
name = "three colours"
[panel]
height = 64
width = 80
[propagation]
distance_mm = 8.0
[[channel]]
name = "red"
wavelength_nm = 638.0
[[channel]]
name = "green"
wavelength_nm = 520.0
[[channel]]
name = "blue"
wavelength_nm = 450.0
[[defect]]
kind = "phase_response"
gain = 1.1
s_curvature = 0.15
"""


@pytest.mark.usefixtures("real_time")
def test_the_camera_sees_each_colour_alone_in_the_frame_that_it_is_shown_in(tmp_path: Path) -> None:
    """Against the bench's noise-free truth, each colour for a time that makes up for what its pattern should give."""
    spec = str(tmp_path / "bench.toml")
    Path(spec).write_text(IN_COLOUR)
    truth = open_headset(spec)
    bench = nominal_bench(truth)
    channels = [c.name for c in bench.channels]
    target = target_of("astronaut", channels, bench.panel.shape)
    gray = np.random.default_rng(0).integers(0, 256, target.shape, dtype=np.uint8)
    given = np.array([1.0, 2.5, 1.6])
    (seen,) = on_hardware(spec, bench, [("noise", target, {"after": Solved(gray, given)})], tmp_path)
    black = bench.camera.black_level
    expected = np.stack([truth.expected_counts(g, c) - black for g, c in zip(gray, channels, strict=True)])
    expected = expected / given[:, None, None]
    scale = np.vdot(expected, seen.lights["after"]) / np.vdot(expected, expected)
    for light, wanted in zip(seen.lights["after"], scale * expected, strict=True):
        assert light.mean() == pytest.approx(wanted.mean(), rel=0.02)
        assert np.corrcoef(light.ravel(), wanted.ravel())[0, 1] > 0.98
    assert set(seen.channels["after"]) == set(channels)


def test_a_machine_that_is_too_busy_is_said_with_what_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []

    def dark(*_: object, **__: object) -> None:
        tried.append(1)
        raise DeviceError("the lasers are off.")

    monkeypatch.setattr(demo_run, "emulated", dark)
    bench = nominal_bench(open_headset("virtual:small_demo"))
    solved = {"after": Solved(np.zeros((1, 8, 8), np.uint8), np.ones(1))}
    with pytest.raises(DeviceError, match="the lasers are off. So ended .* 'astronaut'.* too busy") as said:
        on_hardware(
            "virtual:small_demo", bench, [("astronaut", np.ones((1, 8, 8)), solved)], tmp_path / "patterns"
        )
    assert len(tried) == demo_run.TRIES and str(tmp_path) in str(said.value)


@pytest.mark.slow
@pytest.mark.usefixtures("real_time")
def test_the_demo_in_colour(tmp_path: Path) -> None:
    spec = tmp_path / "bench.toml"
    spec.write_text(IN_COLOUR)
    result = run_demo(tmp_path / "demo", Demonstrated(str(spec), patterns=6))
    assert "phase_response" in result["found"] and result["verdict"] == "complete"
    assert set(result["channels"]) == {"red", "green", "blue"}
    for of in [*result["channels"].values(), result["display"]]:
        psnr = {which: numbers["psnr_db"] for which, numbers in of.items()}
        assert psnr["after"] > psnr["before"] + 5, psnr
        assert psnr["oracle"] > psnr["after"] - 0.5, psnr
    assert "red" in result["sentence"] and "in turn" in result["sentence"]
    (picture,) = result["pictures"]
    assert picture["channels"] == result["channels"]
    patterns = tmp_path / "demo" / "patterns"
    for name in ("astronaut-target", "astronaut-before-seen", "astronaut-after-seen"):
        with Image.open(patterns / f"{name}.png") as image:
            assert image.mode == "RGB"
    assert {p.name for p in patterns.glob("astronaut-after-*.png")} == {
        f"astronaut-after-{what}.png" for what in ("red", "green", "blue", "seen")
    }


def test_the_benches_of_the_demo_in_colour_are_those_of_one_colour_with_two_more() -> None:
    for pair in ((USUAL, COLOUR), (QUICK, QUICK_COLOUR)):
        one, three = (load_bench(what.bench) for what in pair)
        assert [c.name for c in three.channels] == ["red", "green", "blue"]
        assert (three.panel, three.propagation, three.defects) == (one.panel, one.propagation, one.defects)
        assert one.channels[0] == three.channel(one.channels[0].name)


def test_a_demo_after_a_demo_gets_a_folder_of_its_own(tmp_path: Path) -> None:
    wanted = tmp_path / "hololoop-demo"
    for name in ("hololoop-demo", "hololoop-demo-2", "hololoop-demo-3"):
        folder = first_free(wanted)
        assert folder == tmp_path / name
        folder.mkdir()


def test_the_bench_of_full_size_has_the_same_faults_and_a_headsets_pixels() -> None:
    full, colour = load_bench(FULL_SIZE.bench), load_bench(COLOUR.bench)
    assert (full.defects, full.channels) == (colour.defects, colour.channels)
    assert (full.panel.height, full.panel.width) == (full.camera.height, full.camera.width) == (1080, 1920)
