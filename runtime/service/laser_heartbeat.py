"""The lasers' thread: the heartbeat of the safety controller, and power only while a fresh pattern is displayed.

Nothing here makes light safe; the safety controller does. This thread feeds the controller's dead-man timer while
panel, solver, camera and the service's own loop show signs of life. It asks for power only while a fresh pattern is on
the panel, and it switches the lasers off after any error on the bus. When this process dies or hangs, the heartbeat
ends and the controller switches the lasers off by itself.
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers.safety_controller import Fault
from runtime.service.protocol import LaserState

BEAT_S, RAMP_STEP_S = 0.020, 0.005
LOOK_S = 0.1  # between requests for the state of a board that is not armed
AGAIN_S = 0.05  # between attempts to open the lasers
RISE_AGAIN_S = 1.0  # after a pattern lowered the power
CLEAR_TO_ARM_S = 5.0
DEVICE_ERRORS = (DeviceError, InputError, OSError)
STATES = {
    "off": LaserState.OFF,
    "armed": LaserState.ARMED,
    "emit": LaserState.EMITTING,
    "fault": LaserState.FAULT,
}


@dataclass(frozen=True)
class LaserRequest:
    """A request to the lasers, and the function that gets the answer: None for done, else what is wrong."""

    what: str
    answer: Callable[[str | None], None]


class LaserHeartbeat(threading.Thread):
    """Owns the lasers.

    Parameters
    ----------
    open_lasers : callable
        Opens the lasers, dark; called again whenever the bus was lost.
    power : dict of str to float
        Fraction of full power for each channel while a fresh pattern is displayed.
    fresh_until : callable
        Returns, by name, until when each part that light depends on counts as fresh (CLOCK_MONOTONIC, ns).
    lit_until_ns : callable
        Returns until when the pattern on the panel may be lit (CLOCK_MONOTONIC, ns).
    fault : callable
        Called with a kind and a sentence for each fault, in this thread.
    colours : callable
        Returns the channels of a pattern's colours, where it has several; else none.
    lit : callable
        Returns which of them have light in the frame on the panel; None: the panel does not gate the lasers.

    Attributes
    ----------
    state : LaserState
        State of the safety controller.
    faults : int
        Bits of the safety controller's faults.
    turned_ns : int, ns
        When the loop last turned: the thread's own sign of life.
    level : dict of str to float
        Present power of each channel, fraction of full.
    """

    def __init__(
        self,
        open_lasers: Callable[[], Any],
        power: dict[str, float],
        fresh_until: Callable[[], dict[str, int]],
        lit_until_ns: Callable[[], int],
        fault: Callable[[str, str], None],
        colours: Callable[[], Sequence[str]] = tuple,
        lit: Callable[[], frozenset[str] | None] = lambda: None,
    ) -> None:
        super().__init__(name="lasers", daemon=True)
        self._open, self._power, self._fresh_until = open_lasers, power, fresh_until
        self._lit_until_ns, self._fault = lit_until_ns, fault
        self._colours, self._lit = colours, lit
        self._raised: frozenset[str] = frozenset()  # channels whose power was raised since the last darkness
        self._lasers: Any = None
        self._ramp: Iterator[None] | None = None
        self._requests: deque[LaserRequest] = deque()
        self._wake = threading.Event()
        self._stopping = False
        self._out = False  # the board was lost, and has not told its state since
        self._cleared_at = -CLEAR_TO_ARM_S
        self._looked_at = 0.0
        self._risen_at = 0.0
        self._expected: dict[str, tuple[float, ...]] = {}
        self.state, self.faults = LaserState.LOST, 0
        self.level = dict.fromkeys(power, 0.0)
        self.turned_ns = time.monotonic_ns()

    @property
    def armed(self) -> bool:
        """Whether light is possible."""
        return self.state in (LaserState.ARMED, LaserState.EMITTING)

    def ask(self, what: str, answer: Callable[[str | None], None]) -> None:
        """Ask for "clear", "arm" or "dark"; `answer` is called in this thread."""
        self._requests.append(LaserRequest(what, answer))
        self._wake.set()

    def expect(self, shares: bytes, then: Callable[[], None]) -> None:
        """Set the limits of power for the next pattern, then call `then`.

        Parameters
        ----------
        shares : bytes
            13 float32 a colour, from eye_safety.spot_shares: the light that the pattern is predicted to make. Zeros: it
            is not predicted, and all light counts as one spot.
        then : callable
            Called when the power is right for the pattern.
        """
        if not any(shares) or not self.armed:
            then()
            return
        colours = self._colours()
        if len(colours) > 1:
            groups = struct.iter_unpack("<13f", shares[: 52 * len(colours)])
            self._expected = dict(zip(colours, groups, strict=True))
        else:
            self._expected = dict.fromkeys(self._power, struct.unpack_from("<13f", shares))
        self.ask("expect", lambda problem: then())

    def stop(self) -> None:
        """Switch the lasers off at once, then end the thread."""
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
                pause = BEAT_S if self._ramp is None else RAMP_STEP_S
            except DEVICE_ERRORS as error:
                self._lost(error)
                pause = AGAIN_S
            self._wake.wait(max(0.0, began + pause - time.monotonic()))
            self._wake.clear()
        self._close()

    def _turn(self) -> None:
        """One beat: requests, signs of life, the heartbeat, the power."""
        while self._requests:
            request = self._requests.popleft()
            request.answer(self._do(request.what))
        if self._lasers is None:
            self._lost(DeviceError("the laser board could not be opened"))
            return
        if not self.armed:
            if time.monotonic() - self._looked_at >= LOOK_S:
                self._look()
            return
        now = time.monotonic_ns()
        if silent := self._silent(now):
            self._lasers.trip()
            self._darkened("silent", f"dark: no sign of life of {', '.join(silent)}")
            return
        lit = self._lit()
        try:
            if lit is None:
                self._lasers.heartbeat()
            else:
                self._lasers.heartbeat(self._power.keys() - lit)
            self._light(now < self._lit_until_ns())
        except DeviceError as error:  # the driver has switched everything off before it raised
            self._darkened("lasers", str(error))

    def _light(self, on: bool) -> None:
        """Raise the power slowly while a fresh pattern is displayed; switch off at once when none is."""
        if not on:
            self._ramp, self._raised = None, frozenset()
            if self.state == LaserState.EMITTING:
                self._lasers.off()
                self.state = LaserState.ARMED
        elif self._ramp is None and (self.state == LaserState.ARMED or self._may_rise()):
            raised = self._with_light()
            self._ramp = chain.from_iterable(self._lasers.ramp(c, self._power[c]) for c in raised)
            self._raised |= frozenset(raised)
            self._risen_at = time.monotonic()
            self.state = LaserState.EMITTING
        try:
            if self._ramp is not None and next(self._ramp, self) is self:
                self._ramp = None
        except InputError as error:  # the pattern's bright spots do not allow it
            self._ramp = None
            self._fault("budget", str(error))
        self.level = {channel: self._lasers.power(channel) for channel in self._power}

    def _may_rise(self) -> bool:
        """Whether a colour has light for the first time, or a pattern lowered the power and enough time has passed."""
        lit = self._with_light()
        if not self._raised.issuperset(lit):
            return True
        lowered = any(self.level[channel] < self._power[channel] for channel in lit)
        return lowered and time.monotonic() - self._risen_at > RISE_AGAIN_S

    def _with_light(self) -> list[str]:
        """Channels that have light in the frame on the panel."""
        lit = self._lit()
        return [channel for channel in self._power if lit is None or channel in lit]

    def _do(self, what: str) -> str | None:
        """Do what was asked; returns what is wrong, or None."""
        now = time.monotonic()
        try:
            if what == "expect":
                self._lasers.expect({c: s for c, s in self._expected.items() if c in self._power})
            elif what == "dark":
                self._lasers.trip()
                self._dark()
            elif what == "clear":
                # a board that was without power has lost its ceilings and limits: set all of them again
                self._close()
                self._lasers = self._open()
                self._lasers.clear()
                self._cleared_at = now
                self.state, self.faults = LaserState.OFF, 0
            elif now - self._cleared_at > CLEAR_TO_ARM_S:
                return f"send Clear first, at most {CLEAR_TO_ARM_S:g} s before Arm"
            elif silent := self._silent(time.monotonic_ns()):
                return f"there is no sign of life of {', '.join(silent)}: the lasers stay dark until there is"
            else:
                self._cleared_at = -CLEAR_TO_ARM_S
                self._lasers.arm()
                self.state = LaserState.ARMED
        except DEVICE_ERRORS as error:
            self._dark()
            return str(error)
        return None

    def _silent(self, now_ns: int) -> list[str]:
        return [name for name, until_ns in self._fresh_until().items() if until_ns < now_ns]

    def _darkened(self, kind: str, text: str) -> None:
        """Note the fault that has made the lasers dark."""
        self._fault(kind, text)
        self._dark()

    def _dark(self) -> None:
        """The driver has switched everything off; the next turn asks the board for its state."""
        self._ramp, self._raised = None, frozenset()
        self.level = dict.fromkeys(self._power, 0.0)
        self._looked_at = 0.0
        if self.armed:
            self.state = LaserState.FAULT

    def _look(self) -> None:
        """Ask the board for its state.

        Raises
        ------
        DeviceError
            Where it does not answer.
        """
        self._ramp = None
        self._looked_at = time.monotonic()
        status = self._lasers.status()
        self._out = False
        self.state = STATES[status["state"]]
        self.faults = sum(Fault[name.upper()] for name in status["faults"])
        self.level = dict(status["power"])

    def _lost(self, error: Exception) -> None:
        """The board does not answer: without a heartbeat it switches the lasers off by itself. Open it again."""
        if not self._out:
            self._fault("laser_bus", str(error))
        self._out = True
        self.state, self.faults = LaserState.LOST, 0
        while self._requests:
            self._requests.popleft().answer(f"the lasers do not answer: {error}")
        self._close()

    def _close(self) -> None:
        self._ramp = None
        if self._lasers is not None:
            with suppress(*DEVICE_ERRORS):
                self._lasers.close()
            self._lasers = None
