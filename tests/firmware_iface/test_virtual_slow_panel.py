"""A slow panel in emulated hardware: it takes a step in each period of its board, whoever takes pictures."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError
from firmware_iface.lasers import VIRTUAL_CHANNELS
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.lasers.guarded_lasers import GuardedLasers, open_guarded_lasers
from firmware_iface.panel import Panel, open_board
from firmware_iface.panel.fields import FieldPanel, colours_in_turn
from firmware_iface.panel.panel_board_messages import Timing
from firmware_iface.virtual import VirtualHeadset, open_headset
from firmware_iface.virtual.remote_hardware import RemoteCamera, i2c_bus, reach, running, usb_backend

pytestmark = pytest.mark.usefixtures("real_time")

SHAPE = (24, 32)
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
[camera]
read_noise_e = 0.5
full_well_e = 1e6
[[defect]]
kind = "slow_response"
share = 0.4
"""
PERIOD_US = 100_000  # time enough for a picture of the first period


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("bench") / "bench.toml"
    file.write_text(BENCH)
    return file


@contextmanager
def emulated(
    folder: Path, bench: Path, period_us: int, **how: Any
) -> Iterator[tuple[Panel, GuardedLasers, RemoteCamera]]:
    """Panel, armed lasers and camera of emulated hardware."""
    socket = folder / "hardware.sock"
    gated = GatedLight(0.5 / 3, 0.5e-6 * period_us, 3e-6 * period_us) if "fields" in how else None
    timing = Timing(period_us, period_us // 4, period_us // 2)
    with running(socket, str(bench)), ExitStack() as stack:
        bus = f"virtual:{socket}"
        panel = open_board(backend=usb_backend(bus), timing=timing, timeout_s=1.0, **how)
        stack.enter_context(closing(panel))
        lasers = stack.enter_context(open_guarded_lasers(i2c_bus(bus), VIRTUAL_CHANNELS, gated))
        yield panel, lasers, stack.enter_context(closing(RemoteCamera(reach(bus))))


def lit_up(lasers: GuardedLasers, *channels: str) -> None:
    """Lasers at full power; again where a busy machine stalled for 100 ms."""
    for attempt in range(5):
        with suppress(DeviceError if attempt < 4 else ()):
            lasers.clear()
            lasers.arm()
            for channel in channels:
                lasers.set_power(channel, 1.0)
            return


def grays(seed: int, count: int = 2) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (count, *SHAPE), dtype=np.uint8)


def lit_headset(bench: Path, *channels: str) -> VirtualHeadset:
    headset = open_headset(str(bench), seed=3)
    for channel in channels:
        headset.lasers.set_power(channel, 1.0)
    return headset


def off(seen: NDArray[np.uint16], expected: NDArray[np.uint16]) -> float:
    """How far pictures are from one another: 0 for the same but for noise, about 1 for others."""
    a, b = (picture.astype(float) - picture.mean() for picture in (seen, expected))
    return float(1 - (a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


def test_a_picture_has_the_panel_as_far_as_its_periods_took_it(tmp_path: Path, bench: Path) -> None:
    first, second = grays(1)
    expected = []
    for periods in (0, 1, 2, 20):
        headset = lit_headset(bench, "green")
        headset.has_shown([(first, 64), (second, periods)])
        headset.panel.show(second)
        expected.append(headset.camera.capture())
    with emulated(tmp_path, bench, PERIOD_US) as (panel, lasers, camera):
        for _ in range(
            8
        ):  # again where a busy machine was too late for the first period, or had the lasers go dark
            lit_up(lasers, "green")
            with suppress(DeviceError), lasers.beating():
                panel.show(first)
                time.sleep(0.9)
                panel.show(second)
                soon = camera.capture()
                time.sleep(0.9)
                late = camera.capture()
            places = [int(np.argmin([off(one, e) for e in expected])) for one in (soon, late)]
            if places[0] == 0 and min(off(late, e) for e in expected) < 0.01:
                break
    assert places[0] == 0 and places[1] >= 2
    assert off(soon, expected[0]) < 0.01 and off(late, expected[3]) < 0.01
    assert off(soon, expected[3]) > 0.05


def test_a_field_still_shows_a_share_of_the_one_before(tmp_path: Path, bench: Path) -> None:
    patterns, period_us = grays(2), 2000
    frame = colours_in_turn(patterns, (0, 1), (1.0, 1.0), period_us)
    slow = lit_headset(bench, "red", "green")
    slow.has_shown([(gray, 1) for gray in (*patterns, *patterns, *patterns, *patterns)])
    slow.camera.exposure_ms = 40.0
    slow.panel.show_fields(colours_in_turn(patterns, (0, 1), (1.0, 1.0), slow.panel.field_us))
    expected = slow.camera.capture()
    settled = sum(
        0.5 * (slow.expected_counts(gray, channel) - 64)
        for gray, channel in zip(patterns, ("red", "green"), strict=True)
    )
    with emulated(tmp_path, bench, period_us, fields=2) as (panel, lasers, camera):
        assert isinstance(panel, FieldPanel)
        camera.exposure_ms = 40.0
        panel.show_fields(frame)
        for _ in range(8):  # again where a busy machine had the lasers go dark
            lit_up(lasers, "red", "green")
            with suppress(DeviceError), lasers.beating():
                time.sleep(0.1)
                seen = camera.capture()
            if off(seen, expected) < 0.02:
                break
    assert off(seen, expected) < 0.02
    assert off(seen, np.asarray(settled)) > 0.1
