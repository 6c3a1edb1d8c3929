"""The panel's thread: order, retries, staleness, a panel that is disconnected and connected again."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from firmware_iface.errors import DeviceError, DeviceGoneError
from runtime.lightpath.overdrive import NEAREST, REACHED, overdrive_tables
from runtime.service.display_thread import DisplayClock, DisplayPattern, DisplayThread
from runtime.service.slow_panel import SlowPanel
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("real_time")  # its thread needs its share of the cores

PERIOD_NS = 5_000_000
STALE_NS = 100_000_000


class Panel:
    """Records what it is shown; fails as the test sets it."""

    def __init__(self) -> None:
        self.shown: list[int] = []
        self.failures: list[Exception] = []
        self.connected = True
        self.opened = 0

    def open(self) -> Panel:
        if not self.connected:
            raise DeviceGoneError("unplugged")
        self.opened += 1
        return self

    def show(self, gray: np.ndarray) -> None:
        self._fail()
        self.shown.append(int(gray[0, 0]))

    def status(self) -> dict:
        self._fail()
        return {}

    def close(self) -> None:
        pass

    def _fail(self) -> None:
        if not self.connected:
            raise DeviceGoneError("unplugged")
        if self.failures:
            raise self.failures.pop()


class Events:
    def __init__(self) -> None:
        self.shown_jobs: list[int] = []
        self.dropped_jobs: list[int] = []
        self.faults: list[str] = []

    def shown(self, pattern: DisplayPattern, at_ns: int, transfer_s: float) -> None:
        self.shown_jobs.append(pattern.job)

    def dropped(self, pattern: DisplayPattern, reason: str) -> None:
        self.dropped_jobs.append(pattern.job)

    def panel_fault(self, error: Exception, ongoing: bool) -> None:
        if not ongoing:
            self.faults.append(str(error))


@pytest.fixture
def running() -> Iterator[tuple[Panel, DisplayThread, Events]]:
    panel, events = Panel(), Events()
    display = DisplayThread(panel.open, DisplayClock(PERIOD_NS), STALE_NS, events)
    display.start()
    yield panel, display, events
    display.stop()


def ready(job: int, in_ns: int, value: int | None = None, final: bool = True) -> DisplayPattern:
    gray = np.full((1, 2, 2), job if value is None else value, np.uint8)
    return DisplayPattern(job, time.monotonic_ns() + in_ns, gray, 0, 30.0, final)


def test_patterns_are_shown_in_order_and_not_before_their_time(running) -> None:
    panel, display, events = running
    late = ready(2, 20 * PERIOD_NS)
    display.put(late)
    display.put(ready(1, 3 * PERIOD_NS))
    until(lambda: events.shown_jobs == [1, 2])
    assert time.monotonic_ns() > late.display_ns - PERIOD_NS
    assert panel.shown == [1, 2] and not events.dropped_jobs


def test_the_best_pattern_by_the_display_time_is_shown(running) -> None:
    panel, display, events = running
    display.put(ready(1, 4 * PERIOD_NS, value=7, final=False))
    display.put(ready(1, 4 * PERIOD_NS, value=9))
    until(lambda: events.shown_jobs == [1])
    assert panel.shown == [9]


def test_a_better_pattern_that_comes_too_late_does_not_replace_the_one_that_was_announced(running) -> None:
    panel, display, events = running
    first, better = ready(1, 0, value=7, final=False), ready(1, 0, value=9)

    def show(gray: np.ndarray) -> None:
        panel.shown.append(int(gray[0, 0]))
        if len(panel.shown) == 1:
            display.put(better)  # during the transfer

    panel.show = show
    display.put(first)
    until(lambda: events.shown_jobs == [1])
    display.put(better)
    display.put(ready(2, 4 * PERIOD_NS, value=20))
    until(lambda: events.shown_jobs[-1] == 2)
    assert panel.shown == [7, 20] and events.shown_jobs == [1, 2]


def test_a_better_pattern_takes_the_place_of_one_that_the_panel_did_not_accept(running) -> None:
    panel, display, events = running

    def show(gray: np.ndarray) -> None:
        if gray[0, 0] == 7:
            display.put(ready(1, 0, value=9))
            raise DeviceError("short")
        panel.shown.append(int(gray[0, 0]))

    panel.show = show
    display.put(ready(1, 0, value=7, final=False))
    until(lambda: events.shown_jobs == [1])
    assert panel.shown == [9]


def test_a_pattern_that_the_panel_did_not_accept_is_tried_again(running) -> None:
    panel, display, events = running
    panel.failures = [DeviceError("short"), DeviceError("garbage")]
    display.put(ready(1, 0))
    until(lambda: events.shown_jobs == [1])
    assert events.faults and panel.opened == 1


def test_a_stale_pattern_is_dropped_and_not_shown(running) -> None:
    panel, display, events = running
    display.put(ready(1, -2 * STALE_NS))
    until(lambda: events.dropped_jobs == [1])
    assert panel.shown == [] and display.lit_until_ns == 0


def test_a_panel_that_comes_back_shows_again_and_meanwhile_frames_are_dropped(running) -> None:
    panel, display, events = running
    panel.connected = False
    display.put(ready(1, PERIOD_NS))
    until(lambda: events.dropped_jobs == [1] and not display.open)
    answered = display.answered_ns
    panel.connected = True
    until(lambda: display.open)
    display.put(ready(2, PERIOD_NS))
    until(lambda: events.shown_jobs == [2])
    assert display.answered_ns > answered and panel.opened == 2
    assert events.faults == ["unplugged"]  # one outage, however often it was tried


def test_an_idle_panel_is_asked_for_signs_of_life(running) -> None:
    _, display, _ = running
    until(lambda: display.answered_ns > 0)
    before = display.answered_ns
    until(lambda: display.answered_ns > before)


def test_light_is_allowed_for_the_stale_limit_only(running) -> None:
    _, display, events = running
    pattern = ready(1, PERIOD_NS)
    display.put(pattern)
    until(lambda: events.shown_jobs == [1])
    assert 0 <= display.lit_until_ns - pattern.display_ns - STALE_NS <= 40 * PERIOD_NS


@pytest.mark.parametrize("offset", [-3, 0, 1, 4_999_999, 5_000_000, 123_456_789])
def test_the_clock_gives_the_first_display_time_that_is_not_before(offset: int) -> None:
    clock = DisplayClock(PERIOD_NS)
    tick = clock.after(clock.origin_ns + offset)
    assert (tick - clock.origin_ns) % PERIOD_NS == 0
    assert 0 <= tick - (clock.origin_ns + offset) < PERIOD_NS


TABLES = overdrive_tables(2 * np.pi * np.arange(256) / 256, 0.3)


@pytest.fixture
def slow(running) -> tuple[Panel, DisplayThread, Events]:
    running[1].slow = SlowPanel(TABLES[None])
    return running


def test_a_slow_panel_is_overdriven_and_then_shown_the_plain_pattern_without_being_asked(slow) -> None:
    panel, display, events = slow
    display.put(ready(1, 3 * PERIOD_NS, value=100))
    until(lambda: events.shown_jobs == [1])
    time.sleep(20 * PERIOD_NS * 1e-9)
    assert panel.shown == [100], "of what was before nothing is known, and what stays is not sent again"
    display.put(ready(2, 3 * PERIOD_NS, value=170))
    until(lambda: panel.shown[-1] == 170)
    time.sleep(10 * PERIOD_NS * 1e-9)
    assert panel.shown[1] == TABLES[NEAREST, 100, 170] == 200 and panel.shown[-1] == 170
    assert events.shown_jobs == [1, 2], "the program is told once"


def test_a_panel_that_is_not_slow_gets_every_pattern_once_and_as_it_is(running) -> None:
    panel, display, events = running
    for job, value in ((1, 100), (2, 170)):
        display.put(ready(job, 3 * PERIOD_NS, value))
        until(lambda job=job: events.shown_jobs[-1:] == [job])
    time.sleep(10 * PERIOD_NS * 1e-9)
    assert panel.shown == [100, 170]


def test_after_a_fault_a_slow_panel_is_dark_until_it_has_a_pattern_as_it_is(slow) -> None:
    panel, display, events = slow
    note = events.shown

    def shown(pattern: DisplayPattern, at_ns: int, transfer_s: float) -> None:
        if pattern.job == 2:
            panel.failures = [
                DeviceError("garbage")
            ]  # at the display time after, when the plain pattern is to follow
        note(pattern, at_ns, transfer_s)

    events.shown = shown  # type: ignore[method-assign]
    for job, value in ((1, 10), (2, 100)):
        display.put(ready(job, 0, value))
        until(lambda job=job: events.shown_jobs[-1:] == [job])
    assert panel.shown[:2] == [10, TABLES[NEAREST, 10, 100]]
    until(lambda: events.faults)
    assert display.lit_until_ns == 0 and len(panel.shown) == 2
    display.put(ready(3, 0, 200))
    until(lambda: events.shown_jobs == [1, 2, 3])
    assert panel.shown[2] == 200 and display.lit_until_ns > 0
    display.put(ready(4, 0, 100))
    until(lambda: events.shown_jobs[-1] == 4)
    assert panel.shown[3] == TABLES[NEAREST, 200, 100] == 57


def test_a_slow_panel_that_comes_back_gets_its_first_pattern_as_it_is(slow) -> None:
    panel, display, events = slow
    for job, value in ((1, 10), (2, 100)):
        display.put(ready(job, 0, value))
        until(lambda job=job: events.shown_jobs[-1:] == [job])
    panel.connected = False
    until(lambda: not display.open)
    shown, panel.connected = len(panel.shown), True
    until(lambda: display.open)
    display.put(ready(3, PERIOD_NS, 200))
    until(lambda: events.shown_jobs[-1] == 3)
    assert panel.shown[shown] == 200


def test_a_dropped_pattern_was_never_before_another(slow) -> None:
    panel, display, events = slow
    display.put(ready(1, 0, 50))
    until(lambda: events.shown_jobs == [1])
    display.put(ready(2, -2 * STALE_NS, 250))
    until(lambda: events.dropped_jobs == [2])
    display.put(ready(3, 3 * PERIOD_NS, 80))
    until(lambda: events.shown_jobs == [1, 3])
    assert panel.shown[1] == TABLES[NEAREST, 50, 80] and TABLES[REACHED, 50, panel.shown[1]] == 80
