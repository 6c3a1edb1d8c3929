"""Colours in turn on a simulated bench: the camera integrates over a frame, and each field has its own light alone."""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers import VIRTUAL_CHANNELS
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.lasers.guarded_lasers import GuardedLasers, open_guarded_lasers
from firmware_iface.panel import open_board
from firmware_iface.panel.fields import Field, FieldPanel, colours_in_turn
from firmware_iface.panel.panel_board_messages import Timing
from firmware_iface.virtual import open_headset
from firmware_iface.virtual.emulated_hardware import _lit_s
from firmware_iface.virtual.remote_hardware import (
    RemoteCamera,
    RemoteHardware,
    i2c_bus,
    reach,
    running,
    usb_backend,
)
from firmware_iface.virtual.usb.panel_board import LitPattern

pytestmark = pytest.mark.usefixtures("real_time")

SHAPE = (24, 32)
COLOURS = ("red", "green", "blue")
BENCH = """
[panel]
height = 24
width = 32
[propagation]
distance_mm = 6.0
[[channel]]
name = "red"
wavelength_nm = 638.0
[[channel]]
name = "green"
wavelength_nm = 520.0
[[channel]]
name = "blue"
wavelength_nm = 450.0
[camera]
read_noise_e = 0.5
full_well_e = 1e6
"""
FIELD_US = 2000
GATED = GatedLight(duty=0.5 / 3, pulse_s=1e-6 * FIELD_US / 2, frame_s=3e-6 * FIELD_US)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("bench") / "bench.toml"
    file.write_text(BENCH)
    return file


def grays(seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (3, *SHAPE), dtype=np.uint8)


def truths(bench: Path, patterns: NDArray[np.uint8]) -> list[NDArray[np.float64]]:
    """Noise-free counts above black at full power and 10 ms, [h, w], of pattern k in colour k."""
    headset = open_headset(str(bench))
    black = headset.description.camera.black_level
    return [headset.expected_counts(g, c) - black for g, c in zip(patterns, COLOURS, strict=True)]


def test_the_camera_sees_the_sum_of_the_colours_each_for_its_share_of_the_frame(bench: Path) -> None:
    headset = open_headset(str(bench), seed=1)
    for channel in COLOURS:
        headset.lasers.set_power(channel, 1.0)
    headset.camera.exposure_ms = 30.0
    brightness = (1.0, 0.5, 0.2)
    headset.panel.show_fields(colours_in_turn(grays(), (0, 1, 2), brightness, headset.panel.field_us))
    seen = headset.camera.capture() - headset.description.camera.black_level
    # a third of the time each, half of that at most with light, in three times the exposure
    expected = sum(0.5 * b * t for b, t in zip(brightness, truths(bench, grays()), strict=True))
    assert seen.mean() == pytest.approx(expected.mean(), rel=0.01)
    assert np.corrcoef(seen.ravel(), expected.ravel())[0, 1] > 0.995


def test_the_camera_sees_the_mean_of_several_patterns_of_each_colour(bench: Path) -> None:
    """Two colours with two patterns each: all colours in turn, and again."""
    headset = open_headset(str(bench), seed=1)
    for channel in COLOURS[:2]:
        headset.lasers.set_power(channel, 1.0)
    headset.camera.exposure_ms = 30.0
    patterns = np.concatenate([grays(0)[:2], grays(1)[:2]])
    frame = colours_in_turn(patterns, (0, 1), (1.0, 0.4), headset.panel.field_us)
    assert [field.lasers for field in frame] == [1, 2, 1, 2]
    assert len({(field.lasers, field.width_us) for field in frame}) == 2
    headset.panel.show_fields(frame)
    black = headset.description.camera.black_level
    seen = headset.camera.capture() - black
    truth = [headset.expected_counts(g, COLOURS[k % 2]) - black for k, g in enumerate(patterns)]
    # a quarter of the time each, half of that at most with light, in three times the exposure
    expected = sum(3 / 8 * (1.0, 0.4)[k % 2] * one for k, one in enumerate(truth))
    assert seen.mean() == pytest.approx(expected.mean(), rel=0.01)
    assert np.corrcoef(seen.ravel(), expected.ravel())[0, 1] > 0.995
    assert np.corrcoef(seen.ravel(), (truth[0] + 0.4 * truth[1]).ravel())[0, 1] < 0.9
    with pytest.raises(InputError, match="no whole number"):
        colours_in_turn(patterns[:3], (0, 1), (1.0, 0.4), headset.panel.field_us)


def test_a_fields_light_is_gated(bench: Path) -> None:
    """All lasers are on, and each field has the light of its own mask alone."""
    headset = open_headset(str(bench), seed=1)
    for channel in COLOURS:
        headset.lasers.set_power(channel, 1.0)
    black = headset.description.camera.black_level
    panel, patterns = headset.panel, grays()
    for k, truth in enumerate(truths(bench, patterns)):
        dark = [Field(g, 0, 0, panel.field_us) for g in patterns]
        dark[k] = Field(patterns[k], 1 << k, 0, panel.field_us)
        panel.show_fields(dark)
        seen = headset.camera.capture() - black
        assert seen.mean() == pytest.approx(truth.mean() / 3, rel=0.02)
        assert np.corrcoef(seen.ravel(), truth.ravel())[0, 1] > 0.98
    panel.show_fields([Field(g, 0, 0, panel.field_us) for g in patterns])
    assert headset.camera.capture().mean() == pytest.approx(black, abs=0.5)
    with pytest.raises(InputError, match="does not fit"):
        panel.show_fields([Field(patterns[0], 1, 1, panel.field_us)])


@pytest.mark.parametrize("exposure_s", [0.006, 0.0021, 0.0004, 0.0171])
@pytest.mark.parametrize("begin_s", [0.0, 0.0015, 0.0039, 0.0058])
def test_an_exposure_gets_the_light_of_the_pulses_that_it_meets(begin_s: float, exposure_s: float) -> None:
    """Against a count of microseconds."""
    pattern = LitPattern(np.zeros(SHAPE, np.uint8), 1, begins_s=0.0025, width_s=0.0012)
    at = np.arange(round(begin_s * 1e6), round((begin_s + exposure_s) * 1e6)) % 6000
    counted = np.count_nonzero((at >= 2500) & (at < 3700)) * 1e-6
    assert _lit_s(pattern, 0.006, begin_s, begin_s + exposure_s) == pytest.approx(counted, abs=2e-6)


@contextmanager
def emulated(
    folder: Path, bench: Path
) -> Iterator[tuple[RemoteHardware, FieldPanel, GuardedLasers, RemoteCamera]]:
    """Panel, lasers and camera of emulated hardware, armed, with a frame on the panel and all lasers lit."""
    socket = folder / "hardware.sock"
    timing = Timing(FIELD_US, FIELD_US // 4, FIELD_US // 2)
    with running(socket, str(bench)) as remote:
        bus = f"virtual:{socket}"
        panel = open_board(backend=usb_backend(bus), timing=timing, fields=3, timeout_s=1.0)
        assert isinstance(panel, FieldPanel)
        with closing(panel), open_guarded_lasers(i2c_bus(bus), VIRTUAL_CHANNELS, GATED) as lasers:
            panel.show_fields(colours_in_turn(grays(), (0, 1, 2), (1.0, 1.0, 1.0), FIELD_US))
            with closing(RemoteCamera(reach(bus))) as camera:
                camera.exposure_ms = 60.0
                yield remote, panel, lasers, camera


def lit_up(lasers: GuardedLasers) -> None:
    """All lasers at full power; again where a busy machine stalled for 100 ms."""
    for attempt in range(5):
        with suppress(DeviceError if attempt < 4 else ()):
            lasers.clear()
            lasers.arm()
            for channel in COLOURS:
                lasers.set_power(channel, 1.0)
            return


def test_down_to_the_bytes_the_camera_sees_the_colours_and_no_field_has_another_ones_light(
    tmp_path: Path, bench: Path
) -> None:
    black = open_headset(str(bench)).description.camera.black_level
    first = truths(bench, grays())
    with emulated(tmp_path, bench) as (remote, panel, lasers, camera):
        assert camera.capture().mean() == pytest.approx(black, abs=0.5)
        for _ in range(5):  # again where a busy machine held up the heartbeat, which makes it dark for good
            lit_up(lasers)
            with lasers.beating():
                counts = camera.capture() - black
                # a panel that takes no more fields goes on showing the one it had: that one alone is lit when it is due
                remote.break_part("panel link", "missing_field", None)
                time.sleep(0.05)
                alone = camera.capture() - black
                remote.repair("panel link")
                lit_throughout = remote.light()[-1][1] > 0
            if lit_throughout:
                break
        expected = sum(first)  # 60 ms, of which each colour has a sixth
        assert counts.mean() == pytest.approx(expected.mean(), rel=0.02)
        assert np.corrcoef(counts.ravel(), expected.ravel())[0, 1] > 0.99
        alike = [np.corrcoef(alone.ravel(), truth.ravel())[0, 1] for truth in first]
        assert max(alike) > 0.98 and alone.mean() == pytest.approx(first[np.argmax(alike)].mean(), rel=0.03)
        panel.close()
        time.sleep(0.02)
        assert remote.light()[-1][1] == 0
        # every field that had light had its own pattern, truly on the panel
        own = {(zlib.crc32(g.tobytes()), 1 << k) for k, g in enumerate(grays())}
        assert remote.lit() == own


@pytest.mark.parametrize("kind", ["torn_field", "swapped_gate", "missing_field"])
def test_a_fault_of_the_panels_link_is_dark_for_its_field_and_no_light_is_wrong(
    tmp_path: Path, bench: Path, kind: str
) -> None:
    with emulated(tmp_path, bench) as (remote, panel, _, _):
        own = set()
        for seed in range(12):
            frame = colours_in_turn(grays(seed), (0, 1, 2), (1.0, 0.6, 0.3), FIELD_US)
            own |= {(zlib.crc32(field.gray.tobytes()), field.lasers) for field in frame}
            remote.break_part("panel link", kind, count=1 + seed % 4, after=seed % 3)
            panel.show_fields(frame)
            remote.repair("panel link")
        assert panel.status()["fields_kept_dark"] >= 6
        assert remote.lit() - {(zlib.crc32(g.tobytes()), 1 << k) for k, g in enumerate(grays())} <= own
        assert len(remote.lit()) >= 12
