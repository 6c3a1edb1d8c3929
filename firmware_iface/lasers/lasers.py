"""Three lasers over I2C, behind the safety controller.

with open_lasers("/dev/i2c-1", CHANNELS) as lasers:
    lasers.arm()
    lasers.set_power("green", 1.0)
    while showing:
        lasers.heartbeat()          # at least every 50 ms, from the loop that must be alive

Every failure (of the bus, of a reply, of the light) has the same result: every part is switched off by itself, and
DeviceError is raised. Nothing is tried twice. When the process dies, the heartbeat ends, and the safety controller
switches off after 100 ms.
"""

from __future__ import annotations

import atexit
import time
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.lasers.heartbeat import Heartbeat
from firmware_iface.lasers.laser_board import LaserBoard
from firmware_iface.lasers.pattern_power import LightBudget
from firmware_iface.lasers.photodiode_watch import PhotodiodeWatch
from firmware_iface.lasers.safety_controller import Command, Input, State

if TYPE_CHECKING:
    from smbus2 import SMBus

UNKNOWN = "the safety controller gives no reason; try again"
RAMP_S, RAMP_STEPS = 0.100, 20  # a rise of 5 ms a step is twice as slow as the safety controller's limiter


class LatchedError(DeviceError):
    """The safety controller has latched a fault and is dark; clear() and arm() once the cause is removed."""


class Lasers:
    """The lasers of one board, opened dark and not armed.

    Parameters
    ----------
    bus : smbus2.SMBus
        Open; it is closed with the lasers.
    channels : sequence of LaserChannel
        One to three, in the order of the DAC's outputs.
    clock : callable
        Gives the time, s.
    wait : callable
        Sleeps, s.
    gated : GatedLight or None
        How the panel gates the lasers to the fields of a frame; None: it does not. Each photodiode then holds what it
        saw in its laser's last field.

    Raises
    ------
    InputError
        Where the channels do not fit the board.
    DeviceError
        Where a part fails or the DAC would not be dark at power-on.
    """

    def __init__(
        self,
        bus: SMBus,
        channels: Sequence[LaserChannel],
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
        gated: GatedLight | None = None,
    ) -> None:
        if not 1 <= len(channels) <= 3 or len({c.name for c in channels}) != len(channels):
            raise InputError(
                "a board has one to three lasers with names of their own; correct the list of lasers."
            )
        self._bus, self._wait = bus, wait
        self._lasers = tuple(channels)
        self.channels = tuple(c.name for c in channels)
        self._budget = LightBudget(channels, gated)
        self._unlit: frozenset[str] = frozenset()
        self.board = LaserBoard(bus)
        self._fractions = [0.0] * len(channels)
        self._watch = PhotodiodeWatch(
            self.board.converter, channels, clock, held_s=0.0 if gated is None else gated.frame_s
        )
        self._ramping = self._closed = False
        with self._dark_on_failure():
            self.board.set_up(self._lasers)
            self._heartbeat = Heartbeat(self.board.controller, clock)
            self._watch.select(0)
        _open.add(self)

    # --- the headset's interface

    def power(self, channel: str) -> float:
        """A laser's power, fraction of full.

        Raises
        ------
        InputError
            For an unknown channel.
        """
        return self._fractions[self._index(channel)]

    def set_power(self, channel: str, fraction: float) -> None:
        """Set a laser to a fraction of full power: down at once, up over 100 ms with the photodiode watched.

        Raises
        ------
        InputError
            Where either is unknown or the lasers together would exceed the Class 1 budget.
        DeviceError
            Where a part fails or the photodiode does not follow (dark by then).
        """
        for _ in self.ramp(channel, fraction):
            self._wait(RAMP_S / RAMP_STEPS)

    def off(self) -> None:
        """Every laser to 0, at once, and read back; the board stays armed.

        Raises
        ------
        DeviceError
            Where the DAC does not do it; every part has then been switched off.
        """
        self._forget()
        with self._dark_on_failure():
            self.board.dac.dark()
            now, _ = self.board.dac.read()
            if not all(output.dark for output in now):
                raise DeviceError(
                    "the DAC did not go dark on command, so the lasers were switched off otherwise."
                )
        self._watch.changed()

    # --- arming and staying alive

    def clear(self) -> None:
        """First step after a fault: clear it.

        Raises
        ------
        DeviceError
            Where it cannot be cleared yet; the message says why.
        """
        self._forget()
        with self._dark_on_failure():
            self.board.dac.dark()
            self.board.controller.command(Command.CLEAR)
            held = self.board.controller.state() is State.FAULT
            needed = Input.INTERLOCK | Input.DARK | Input.COOL | Input.QUIET
            missing = self.board.controller.missing_text(needed) if held else ""
        if held:
            raise DeviceError(f"the fault cannot be cleared: {missing or UNKNOWN}.")

    def arm(self) -> None:
        """Second step: arm the board, dark.

        Raises
        ------
        DeviceError
            Where a condition is missing; the message says which.
        """
        with self._dark_on_failure():
            state = self.board.controller.state()
            if state is State.OFF:
                self._forget()
                self.board.dac.dark()
                self.board.expander.enable((1 << len(self._lasers)) - 1)
                self._heartbeat.beat()
                self.board.controller.command(Command.ARM_FIRST)
                self.board.controller.command(Command.ARM_SECOND)
                state = self.board.controller.state()
            latched = ", ".join(self.board.controller.fault_names())
            # a fault ends the heartbeat, so that a missing one says nothing about the fault's cause
            needed = Input(0x7F) & ~Input.HEARTBEAT if state is State.FAULT else Input(0x7F)
            missing = self.board.controller.missing_text(needed)
        if state is State.FAULT:
            first = f"find its cause; {missing};" if missing else "find its cause,"
            raise DeviceError(f"a fault is latched ({latched}); {first} then clear() and arm().")
        if state is State.OFF:
            raise DeviceError(f"the lasers cannot be armed: {missing or UNKNOWN}.")

    def heartbeat(self, unlit: Collection[str] = ()) -> None:
        """Show that the caller is alive, at least every 50 ms; checks one photodiode each time.

        No token is written sooner than 6 ms after the last.

        Parameters
        ----------
        unlit : collection of str
            Channels that the frame on the panel keeps dark: their photodiodes hold an older light and are not compared.

        Raises
        ------
        DeviceError
            Where a fault is latched, a photodiode shows what it should not, or a part does not answer (dark
            by then).
        """
        self._unlit = frozenset(unlit)
        with self._dark_on_failure():
            self._heartbeat.beat()
            self._raise_latched()
            self._check_photodiode()
            if not self._ramping:
                self._watch.select_next()

    def ramp(self, channel: str, fraction: float) -> Iterator[None]:
        """`set_power`, a step at a time: yields between steps, which should be 5 ms apart.

        For a caller that does other things meanwhile or must be able to stop.
        """
        k = self._index(channel)
        if (
            isinstance(fraction, bool)
            or not isinstance(fraction, int | float | np.floating)
            or not 0 <= fraction <= 1
        ):
            raise InputError(f"power {fraction!r} of laser '{channel}' is not a fraction; give 0 to 1.")
        self._budget.check(self._powers() | {channel: float(fraction)})
        start, end = self._watch.code(k), self._lasers[k].code(fraction)
        if end <= start:
            with self._dark_on_failure():
                self._put(k, end)
            self._fractions[k] = float(fraction)
            return
        with self._dark_on_failure():
            self._raise_latched()
            armed = self.board.controller.state() in (State.ARMED, State.EMIT)
            self._watch.select(k)
        if not armed:
            raise DeviceError("the lasers are not armed; arm() them first.")
        self._fractions[k] = float(fraction)
        # below the threshold there is no light to ramp
        start = max(start, min(end, self._lasers[k].code(1e-9)))
        self._ramping = True
        try:
            for step in range(1, RAMP_STEPS + 1):
                # less than requested, where off() or expect() came between the steps
                allowed = self._lasers[k].code(self._fractions[k])
                if allowed == 0:
                    return
                with self._dark_on_failure():
                    self._put(k, min(start + (end - start) * step // RAMP_STEPS, allowed))
                yield
                with self._dark_on_failure():
                    if self._heartbeat.is_due:
                        self._heartbeat.beat()
                    self._check_photodiode()
        finally:
            self._ramping = False

    # --- the Class 1 budget

    def expect(self, shares: Mapping[str, Sequence[float]] | None) -> float:
        """Take the prediction for the next pattern, before it is shown.

        Lowers every laser by one factor, at once, where the pattern's brightest spots would exceed the budget.
        Powers do not rise again by themselves.

        Parameters
        ----------
        shares : mapping of channel to sequence of float, or None
            From `eye_safety.spot_shares`. None: nothing is known, all light counts as one spot.

        Returns
        -------
        float
            The factor; 1 where nothing changed.

        Raises
        ------
        InputError
            Where a channel is unknown or the shares are not those of `spot_shares`.
        DeviceError
            Where the lasers could not be lowered; they are dark then.
        """
        self._budget.expect(shares)
        worst = self._budget.exposure(self._powers()).worst
        factor = min(1.0, 1 / worst) if worst > 0 else 1.0
        if factor < 1:
            self._fractions = [f * factor for f in self._fractions]
            with self._dark_on_failure():
                for k, laser in enumerate(self._lasers):
                    self._put(k, laser.code(self._fractions[k]))
        return factor

    def _powers(self) -> dict[str, float]:
        """Fraction of full power, by channel."""
        return dict(zip(self.channels, self._fractions, strict=True))

    # --- status and checks

    def status(self) -> dict[str, Any]:
        """What the board reports, ready for JSON.

        Raises
        ------
        DeviceError
            Where it does not answer (dark by then).
        """
        with self._dark_on_failure():
            inputs = self.board.controller.inputs()
            fractions = self._powers()
            used = self._budget.exposure(fractions)
            return {
                "state": self.board.controller.state().name.lower(),
                "faults": self.board.controller.fault_names(),
                "holds": {i.name.lower(): bool(inputs & i) for i in Input if i.name},
                "power": fractions,
                "celsius": round(self.board.thermometer.celsius(), 2),
                "class1": {"thermal": used.thermal, "photochemical": used.photochemical, "worst": used.worst},
                "class1_at_full_power": self._budget.exposure_at_full_power().worst,
            }

    def _check_photodiode(self) -> None:
        """Compare the selected photodiode with its expected voltage, once the light has settled."""
        wrong = self._watch.deviation(self._unlit)
        if wrong:
            self._raise_latched()
            raise DeviceError(wrong)

    def _raise_latched(self) -> None:
        if self.board.controller.state() is State.FAULT:
            latched = ", ".join(self.board.controller.fault_names())
            raise LatchedError(f"the safety controller has switched the lasers off: {latched}.")

    # --- single actions

    def _index(self, channel: str) -> int:
        if channel not in self.channels:
            raise InputError(f"there is no laser '{channel}'; use one of {', '.join(self.channels)}.")
        return self.channels.index(channel)

    def _put(self, k: int, code: int) -> None:
        self._watch.expect(k, code)
        self.board.dac.set_code(k, code)
        self._watch.changed()

    @contextmanager
    def _dark_on_failure(self) -> Iterator[None]:
        """Where the block fails, go dark first and then raise."""
        if self._closed:
            raise DeviceError("the lasers are closed; open them again.")
        try:
            yield
        except OSError as error:
            self._go_dark()
            raise DeviceError(
                f"the laser board does not answer ({error.strerror or error}), so the lasers were switched off; "
                "check its power and its bus, then clear() and arm()."
            ) from error
        except BaseException as error:
            self._go_dark(Command.OFF if isinstance(error, InputError | LatchedError) else Command.FAULT)
            raise

    def trip(self) -> None:
        """Latch a fault on the host's request: dark until clear() and arm(). Raises nothing."""
        self._go_dark()

    def _go_dark(self, command: Command = Command.FAULT) -> None:
        self._forget()
        self.board.go_dark(command)

    def _forget(self) -> None:
        self._fractions = [0.0] * len(self._lasers)
        self._watch.expect_darkness()

    def close(self) -> None:
        """Dark, disarmed, every enable off; the bus is closed. May be called again."""
        if self._closed:
            return
        self._closed = True
        self._go_dark(Command.OFF)
        self._bus.close()

    def __enter__(self) -> Lasers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


_open: weakref.WeakSet[Lasers] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    for lasers in list(_open):
        lasers.close()
