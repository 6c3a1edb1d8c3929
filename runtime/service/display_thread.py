"""The panel's thread: at every display time it puts the next pattern that is due on the panel.

Only this thread writes to the panel, so no two frames mix. Patterns are shown in order, one at each display time. A
pattern that the panel did not accept is tried again at the next display time, until it is stale. A panel that was
disconnected is opened again as soon as it answers. A slow panel is overdriven (`slow_panel`), by what it really showed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.panel.fields import colours_in_turn
from runtime.service.slow_panel import SlowPanel

AGAIN_S = 0.02  # between attempts to open the panel
ASK_S = 0.03  # between requests for the status of an idle panel
WAKE_NS = 300_000  # before the transfer begins, for the thread to wake up
DEVICE_ERRORS = (DeviceError, InputError, OSError)


class DisplayClock:
    """The display's times: one every `period_ns` since the start. All times are CLOCK_MONOTONIC, ns."""

    def __init__(self, period_ns: int) -> None:
        self.period_ns = period_ns
        self.origin_ns = time.monotonic_ns()

    def number(self, tick: int) -> int:
        """How many display times there were up to this one."""
        return (tick - self.origin_ns) // self.period_ns

    def after(self, now_ns: int) -> int:
        """The first display time at or after `now_ns`."""
        return self.origin_ns - (self.origin_ns - now_ns) // self.period_ns * self.period_ns


@dataclass(frozen=True)
class DisplayPattern:
    """A pattern that is ready for the panel.

    Attributes
    ----------
    job : int
        Number of the frame's job.
    display_ns : int, ns
        When the frame is to be displayed (CLOCK_MONOTONIC).
    gray : uint8 array [C N, H, W]
        Gray levels of each field: of all colours in turn, N times.
    crc : int
        CRC-32 of `gray`.
    psnr_db : float, dB
        Amplitude PSNR that the calibrated model predicts.
    final : bool
        No better pattern follows for this job.
    dark : bool
        The pattern must not be lit.
    refined : bool
        The pattern is one of a refinement's, which the camera has to capture.
    brightness : tuple of float
        Light of each colour, 0 to 1; empty for one field, which is not gated.
    """

    job: int
    display_ns: int
    gray: np.ndarray
    crc: int
    psnr_db: float
    final: bool
    dark: bool = False
    refined: bool = False
    brightness: tuple[float, ...] = ()


class DisplayEvents(Protocol):
    """Calls that the display makes, in its own thread."""

    def shown(self, pattern: DisplayPattern, at_ns: int, transfer_s: float) -> None:
        """A pattern is on the panel."""

    def dropped(self, pattern: DisplayPattern, reason: str) -> None:
        """A pattern will not be shown."""

    def panel_fault(self, error: Exception, ongoing: bool) -> None:
        """The panel failed to do something; `ongoing`: it was lost before and has not answered since."""


class DisplayThread(threading.Thread):
    """Owns the panel.

    Parameters
    ----------
    open_panel : callable
        Opens the panel; called again whenever the panel was lost.
    clock : DisplayClock
        Display times.
    stale_ns : int, ns
        How long after its display time a pattern may be lit, and how long the panel may be silent.
    events : DisplayEvents
        What is called when a pattern was shown or dropped, or the panel failed.

    Attributes
    ----------
    transfer_ns : int, ns
        Running mean of the time that a transfer to the panel takes.
    taken_ns : int, ns
        Latest display time that has a pattern.
    answered_ns : int, ns
        When the panel last did what it was asked (CLOCK_MONOTONIC).
    turned_ns : int, ns
        When the loop last turned: the thread's own sign of life.
    lit_until_ns : int, ns
        Until when the pattern on the panel may be lit.
    lasers : sequence of int
        The laser of each colour, where a frame has several fields; set when the panel is opened.
    slow : SlowPanel or None
        Overdrives the patterns; None where the panel is not slow.
    lit_colours : frozenset of int or None
        Colours that have light in the frame on the panel; None: it has one field, which is not gated.
    """

    def __init__(
        self, open_panel: Callable[[], Any], clock: DisplayClock, stale_ns: int, events: DisplayEvents
    ) -> None:
        super().__init__(name="display", daemon=True)
        self._open, self._clock, self._stale_ns, self._events = open_panel, clock, stale_ns, events
        self._lock = threading.Lock()
        self._waiting: dict[int, DisplayPattern] = {}  # by job
        self._done: int | None = None  # job that was shown last; a better pattern comes too late for it
        self._panel: Any = None
        self._out = False  # it was lost, and has not answered since
        self._stopping = threading.Event()
        self.transfer_ns = clock.period_ns // 10
        self.taken_ns = 0
        self.answered_ns = 0
        self.turned_ns = time.monotonic_ns()
        self.lit_until_ns = 0
        self.lasers: Sequence[int] = ()
        self.slow: SlowPanel | None = None
        self._on_panel: DisplayPattern | None = None  # shown last; its gray levels are those that are wanted
        self.lit_colours: frozenset[int] | None = None

    @property
    def open(self) -> bool:
        """Whether the panel is open."""
        return self._panel is not None

    def put(self, pattern: DisplayPattern) -> None:
        """Show this at its display time; it replaces an earlier pattern of the same job, unless that was shown."""
        with self._lock:
            if pattern.job != self._done:
                self._waiting[pattern.job] = pattern

    def forget(self) -> None:
        """Discard all waiting patterns: their program has disconnected."""
        with self._lock:
            self._waiting.clear()

    def stop(self) -> None:
        """End the thread and close the panel."""
        self._stopping.set()
        self.join(2)

    def run(self) -> None:
        while not self._stopping.is_set():
            self.turned_ns = time.monotonic_ns()
            if self._panel is None and not self._opened():
                self._drop_stale(time.monotonic_ns(), "the panel is disconnected")
                self._stopping.wait(AGAIN_S)
                continue
            tick = self._clock.after(time.monotonic_ns() + self.transfer_ns + WAKE_NS)
            self._stopping.wait((tick - self.transfer_ns - WAKE_NS - time.monotonic_ns()) * 1e-9)
            self._turn(tick)
        if self._panel is not None:
            with suppress(*DEVICE_ERRORS):
                self._panel.close()

    def _turn(self, tick: int) -> None:
        """Do the work of one display time."""
        pattern, slow, number = self._due(tick), self.slow, self._clock.number(tick)
        try:
            if pattern is not None:
                self.taken_ns = tick
                began = time.monotonic_ns()
                gray = slow.driven(pattern.gray, number, pattern.refined) if slow else pattern.gray
                self._show(pattern, gray)
                self._on_panel = pattern
                self._shown(pattern, tick, began)
            elif slow and self._on_panel and (again := slow.again(number)) is not None:
                self._show(self._on_panel, again)
                self.answered_ns = time.monotonic_ns()
                self._out = False
            elif time.monotonic_ns() - self.answered_ns > ASK_S * 1e9:
                self._panel.status()
                self.answered_ns = time.monotonic_ns()
                self._out = False
        except DEVICE_ERRORS as error:
            self._events.panel_fault(error, self._out)
            if slow:
                # an overdriven pattern that stays shows what nobody has predicted
                self.lit_until_ns = self.lit_until_ns if slow.settled else 0
                slow.forget()
            if isinstance(error, DeviceGoneError | OSError):
                with suppress(*DEVICE_ERRORS):
                    self._panel.close()
                self._panel, self._out = None, True
            if pattern is not None:
                self._keep(pattern)

    def _show(self, pattern: DisplayPattern, gray: np.ndarray) -> None:
        """Show the pattern of one field, or the frame of several, swapped in as a whole, by these gray levels."""
        if len(gray) == 1:
            self._panel.show(gray[0])
            return
        frame = colours_in_turn(gray, self.lasers, pattern.brightness, self._panel.field_us)
        lit = frozenset(k % len(self.lasers) for k, field in enumerate(frame) if field.lasers)
        if self.lit_colours is not None:
            self.lit_colours &= lit  # what the frame before had and this has: until it is displayed
        self._panel.show_fields(frame)
        self.lit_colours = lit

    def _due(self, tick: int) -> DisplayPattern | None:
        """The oldest pattern that is due; drops stale patterns."""
        self._drop_stale(tick, "it could not be shown before it was stale")
        with self._lock:
            due = [p for p in self._waiting.values() if p.display_ns <= tick + self._clock.period_ns // 2]
            if not due:
                return None
            return self._waiting.pop(min(due, key=lambda p: p.display_ns).job)

    def _keep(self, pattern: DisplayPattern) -> None:
        """Try it again at the next display time."""
        with self._lock:
            self._waiting.setdefault(pattern.job, pattern)

    def _drop_stale(self, now_ns: int, reason: str) -> None:
        with self._lock:
            stale = [p for p in self._waiting.values() if now_ns > p.display_ns + self._stale_ns]
            for pattern in stale:
                del self._waiting[pattern.job]
        for pattern in stale:
            self._events.dropped(pattern, reason)

    def _shown(self, pattern: DisplayPattern, tick: int, began_ns: int) -> None:
        now = time.monotonic_ns()
        with self._lock:
            self._done = pattern.job
            self._waiting.pop(pattern.job, None)  # came during the transfer
        took = now - began_ns
        self.transfer_ns = min(int(0.9 * self.transfer_ns + 0.1 * took), self._clock.period_ns // 2)
        self.answered_ns = now
        self._out = False
        self.lit_until_ns = 0 if pattern.dark else pattern.display_ns + self._stale_ns
        self._events.shown(pattern, max(tick, now), took * 1e-9)

    def _opened(self) -> bool:
        try:
            self._panel = self._open()
        except DEVICE_ERRORS as error:
            self._events.panel_fault(error, self._out)
            self._out = True
            return False
        self.answered_ns = time.monotonic_ns()
        return True
