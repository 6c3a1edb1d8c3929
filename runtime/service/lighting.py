"""The lasers' thread: the heartbeat, and light only for what is fresh.

Nothing here makes light safe; the safety controller does. This thread feeds its dead-man while panel, solver,
camera and the service's own loop show signs of life, asks for power only while a fresh pattern is on the
panel, and takes whatever the bus does wrong as a reason to go dark. When this process dies or hangs, the
heartbeat ends and the controller darkens the lasers by itself.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from firmware_iface.errors import DeviceError, InputError
from runtime.service.protocol import Lasers

BEAT_S = 0.02
AGAIN_S = 0.05  # between attempts to open the lasers
CLEAR_TO_ARM_S = 5.0
DEVICE_ERRORS = (DeviceError, InputError, OSError)


@dataclass(frozen=True)
class Request:
    """Something asked of the lasers, and where the answer goes: None for done, else what is wrong."""

    what: str
    answer: Callable[[str | None], None]


class Lighting(threading.Thread):
    """Owns the lasers.

    open_lasers : opens them, dark; called again whenever the bus was lost
    power : fraction of full for each channel while something fresh is shown
    fresh_until : by name, until when each loop that has to be fresh is (CLOCK_MONOTONIC, ns)
    lit_until_ns : until when what is on the panel may be lit
    fault : called with a kind and a sentence for each fault, in this thread
    """

    def __init__(
        self,
        open_lasers: Callable[[], Any],
        power: dict[str, float],
        fresh_until: Callable[[], dict[str, int]],
        lit_until_ns: Callable[[], int],
        fault: Callable[[str, str], None],
    ) -> None:
        super().__init__(name="lighting", daemon=True)
        self._open, self._power, self._fresh_until = open_lasers, power, fresh_until
        self._lit_until_ns, self._fault = lit_until_ns, fault
        self._lasers: Any = None
        self._requests: list[Request] = []
        self._wake = threading.Event()
        self._stopping = False
        self._cleared_at = -CLEAR_TO_ARM_S
        self.state, self.faults = Lasers.LOST, 0
        self.turned_ns = time.monotonic_ns()  # this loop's own sign of life

    def ask(self, what: str, answer: Callable[[str | None], None]) -> None:
        """Ask for "clear", "arm" or "dark"; `answer` is called in this thread."""
        self._requests.append(Request(what, answer))
        self._wake.set()

    def stop(self) -> None:
        """Dark at once, then end the thread."""
        self._stopping = True
        self._wake.set()
        self.join(2)

    def run(self) -> None:
        while not self._stopping:
            began = time.monotonic()
            self.turned_ns = time.monotonic_ns()
            try:
                if self._lasers is None:
                    self._lasers = self._open()
                self._turn()
            except DEVICE_ERRORS as error:
                self._lost(error)
            self._wake.wait(max(0.0, began + (BEAT_S if self._lasers else AGAIN_S) - time.monotonic()))
            self._wake.clear()
        self._darken()

    def _turn(self) -> None:
        """One beat: requests, freshness, power, state."""
        requests, self._requests = self._requests, []
        for request in requests:
            request.answer(self._do(request.what))
        now = time.monotonic_ns()
        silent = self._silent(now)
        if silent and self.state in (Lasers.ARMED, Lasers.EMITTING):
            self._lasers.off()
            self._lasers.latch()
            self._fault("silent", f"dark: no sign of life of {', '.join(silent)}")
        else:
            self._lasers.beat()
        lit = self.state in (Lasers.ARMED, Lasers.EMITTING) and not silent and now < self._lit_until_ns()
        for channel, power in self._power.items():
            wanted = power if lit else 0.0
            if self._lasers.power(channel) != wanted:
                self._lasers.set_power(channel, wanted)
        self.state, self.faults = self._lasers.state()

    def _silent(self, now_ns: int) -> list[str]:
        return [name for name, until_ns in self._fresh_until().items() if until_ns < now_ns]

    def _do(self, what: str) -> str | None:
        """Do what was asked; what is wrong, or None."""
        now = time.monotonic()
        try:
            if what == "dark":
                self._lasers.off()
                self._lasers.disarm()
            elif what == "clear":
                self._lasers.clear()
                self._cleared_at = now
            elif now - self._cleared_at > CLEAR_TO_ARM_S:
                return f"send Clear first, at most {CLEAR_TO_ARM_S:g} s before Arm"
            elif silent := self._silent(time.monotonic_ns()):
                return f"there is no sign of life of {', '.join(silent)}: the lasers stay dark until there is"
            else:
                self._cleared_at = -CLEAR_TO_ARM_S
                self._lasers.arm()
        except DeviceError as error:
            return str(error)
        return None

    def _lost(self, error: Exception) -> None:
        """The bus does not work: what can be done is to stop the heartbeat, and to try again from the start."""
        if self.state != Lasers.LOST:
            self._fault("laser_bus", str(error))
        self.state, self.faults = Lasers.LOST, 0
        requests, self._requests = self._requests, []
        for request in requests:
            request.answer(f"the lasers do not answer: {error}")
        self._darken()

    def _darken(self) -> None:
        if self._lasers is not None:
            with suppress(*DEVICE_ERRORS):
                self._lasers.off()
            with suppress(*DEVICE_ERRORS):
                self._lasers.close()
            self._lasers = None
