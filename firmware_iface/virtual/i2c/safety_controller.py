"""The laser board's safety controller, after firmware_iface/lasers/safety_controller.md."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum, IntFlag
from typing import Protocol

from firmware_iface.virtual.i2c.bus import NackError
from firmware_iface.virtual.i2c.packet_error_code import pec

ADDRESS = 0x36
WINDOW_S, SOONEST_S, ARM_WITHIN_S = 0.100, 0.005, 1.0
TICK_S, RISE_TICKS = 0.001, 50
DARK_V = 0.005
LASERS = range(3)
SLACK_S = 1e-9  # of adding up clock readings


class State(IntEnum):
    """Register STATE."""

    OFF, ARMED, EMIT, FAULT = range(4)


class Fault(IntFlag):
    """Register FAULTS."""

    KEY, INTERLOCK, HEARTBEAT = 1, 2, 4
    OVERPOWER_0, OVERPOWER_1, OVERPOWER_2 = 8, 16, 32
    ALERT, TEMPERATURE, CONFIG, BUS, HOST = 64, 128, 256, 512, 1024


class Wiring(Protocol):
    """Levels at the controller's pins."""

    key: bool
    interlock: bool

    def requested_v(self, laser: int) -> float:
        """Voltage from the DAC."""

    def photodiode_v(self, laser: int) -> float:
        """Voltage from the photodiode."""

    def hot(self) -> bool:
        """The thermometer's ALERT."""

    def over_power(self) -> bool:
        """The converter's ALERT."""


class SafetyController:
    """Gate, limiter and latch.

    Parameters
    ----------
    clock : callable
        Gives the time, s.
    wiring : Wiring
        The board.
    built_for : tuple of (int, int, int)
        (highest drive ceiling, highest photodiode ceiling, threshold) of each laser, 0.1 mV.

    Attributes
    ----------
    faults : Fault
        Latched faults.
    armed : bool
    ceilings : list of [int or None, int or None]
        (drive, photodiode) for each laser; None: not written.
    """

    def __init__(
        self, clock: Callable[[], float], wiring: Wiring, built_for: tuple[tuple[int, int, int], ...]
    ) -> None:
        self._clock, self._wiring, self.built_for = clock, wiring, built_for
        self.power_on()

    def power_on(self) -> None:
        """Dark, not configured, no token received."""
        self.faults = Fault(0)
        self.armed = False
        self.ceilings: list[list[int | None]] = [[None, None] for _ in LASERS]
        self._limits_v = [0.0] * len(LASERS)
        self._token: int | None = None
        self._token_at = -1e9
        self._arm_until = -1e9
        self._ticked = self._clock()
        self._pointer: int | None = None

    # --- the light

    @property
    def gate(self) -> bool:
        """Whether the lasers' supplies are enabled."""
        wiring = self._wiring
        return (
            self.armed and not self.faults and wiring.key and wiring.interlock and self._fresh(self._clock())
        )

    def output_v(self, laser: int) -> float:
        """Voltage at the modulation input of a laser."""
        return min(self._wiring.requested_v(laser), self._limits_v[laser])

    @property
    def state(self) -> State:
        """Register STATE."""
        if self.faults:
            return State.FAULT
        if not self.armed:
            return State.OFF
        return State.EMIT if any(self.output_v(k) > self._threshold_v(k) for k in LASERS) else State.ARMED

    def _threshold_v(self, laser: int) -> float:
        return self.built_for[laser][2] * 1e-4

    # --- time

    def settle(self) -> None:
        """Do what is due by now."""
        now = self._clock()
        deadline = self._token_at + WINDOW_S
        if self.armed and now >= deadline - SLACK_S:
            self._run_until(deadline)
            self._latch(Fault.HEARTBEAT)
        self._run_until(now)
        self._limits_v = [min(a, b) for a, b in zip(self._limits_v, self._next_limits_v(), strict=True)]
        self._watch()

    def _run_until(self, time_s: float) -> None:
        while self.armed and self._ticked + TICK_S <= time_s + SLACK_S:
            self._ticked += TICK_S
            self._limits_v = self._next_limits_v()
            self._watch()
        if not self.armed:
            self._ticked = max(self._ticked, time_s)

    def _next_limits_v(self) -> list[float]:
        """The limits of the next tick; they fall at once, and rise with the tick."""
        limits = []
        for k in LASERS:
            ceiling, threshold = (self.ceilings[k][0] or 0) * 1e-4, self._threshold_v(k)
            step = max(0.0, ceiling - threshold) / RISE_TICKS
            limits.append(min(ceiling, max(self.output_v(k), threshold) + step))
        return limits

    def _watch(self) -> None:
        if not self.armed:
            return
        wiring = self._wiring
        lost = Fault(0)
        if not wiring.key:
            lost |= Fault.KEY
        if not wiring.interlock:
            lost |= Fault.INTERLOCK
        if wiring.hot():
            lost |= Fault.TEMPERATURE
        if wiring.over_power():
            lost |= Fault.ALERT
        for k in LASERS:
            if wiring.photodiode_v(k) > (self.ceilings[k][1] or 0) * 1e-4:
                lost |= Fault(Fault.OVERPOWER_0 << k)
        if lost:
            self._latch(lost)

    def _latch(self, fault: Fault) -> None:
        self.faults |= fault
        self._disarm()

    def _disarm(self) -> None:
        self.armed = False
        self._limits_v = [0.0] * len(LASERS)

    def _fresh(self, now: float) -> bool:
        return self._token is not None and now < self._token_at + WINDOW_S - SLACK_S

    def inputs(self) -> int:
        """Register INPUTS."""
        wiring = self._wiring
        holds = (
            wiring.key,
            wiring.interlock,
            self._fresh(self._clock()),
            all(wiring.requested_v(k) < DARK_V for k in LASERS),
            not wiring.hot(),
            not wiring.over_power(),
            all(value is not None for pair in self.ceilings for value in pair),
        )
        return sum(bool(holding) << bit for bit, holding in enumerate(holds))

    # --- commands of the host

    def _command(self, value: int) -> None:
        now = self._clock()
        second = now <= self._arm_until
        self._arm_until = now + ARM_WITHIN_S if value == 0xA5 else -1e9
        if value == 0x00:
            self._disarm()
        elif value == 0xC3 and self.inputs() & 0b0111010 == 0b0111010:
            self.faults = Fault(0)
        elif value == 0x5A and second and not self.faults and not self.armed and self.inputs() == 0b1111111:
            self.armed, self._ticked = True, now
        elif value == 0xF0:
            self._latch(Fault.HOST)

    def _beat(self, token: int) -> None:
        now = self._clock()
        good = token != self._token and now - self._token_at >= SOONEST_S - SLACK_S
        if not good:
            if self.armed:
                self._latch(Fault.HEARTBEAT)
            self._token = None
            self._token_at = now
            return
        self._token, self._token_at = token, now

    def _set_ceiling(self, kind: int, laser: int, value: int) -> None:
        if self.ceilings[laser][kind] is not None or value > self.built_for[laser][kind]:
            self._latch(Fault.CONFIG)
            raise NackError
        self.ceilings[laser][kind] = value

    # --- bytes

    def write(self, data: bytes) -> None:
        """One write message: a pointer, or register, value and packet error code."""
        if not data:
            return
        register, value = data[0], data[1:-1]
        self._pointer = register
        if len(data) == 1:
            return
        width = 2 if register >= 0x10 else 1
        writable = register in (0x05, 0x06) or (register & 0xF7 in (0x10, 0x11, 0x12))
        whole = len(value) == width and pec(bytes([ADDRESS << 1]) + data[:-1]) == data[-1]
        if not (writable and whole):
            self._latch(Fault.BUS)
            raise NackError
        number = int.from_bytes(value, "little")
        if register == 0x05:
            self._command(number)
        elif register == 0x06:
            self._beat(number)
        else:
            self._set_ceiling(register >> 3 & 1, register & 7, number)

    def read(self, length: int) -> bytes:
        """The register under the pointer of this transfer, then the packet error code."""
        if self._pointer is None:
            return b"\xff" * length
        data = self._value(self._pointer)
        check = pec(bytes([ADDRESS << 1, self._pointer, ADDRESS << 1 | 1]) + data)
        return (data + bytes([check])).ljust(length, b"\xff")[:length]

    def _value(self, register: int) -> bytes:
        fixed = {0x00: b"\x4c", 0x01: b"\x01"}
        if register in fixed:
            return fixed[register]
        if register == 0x02:
            return bytes([self.state])
        if register == 0x03:
            return int(self.faults).to_bytes(2, "little")
        if register == 0x04:
            return bytes([self.inputs()])
        if register == 0x06:
            return bytes([self._token or 0])
        kind, laser = register >> 3 & 1, register & 7
        if laser in LASERS and register >> 4 == 1:
            return (self.ceilings[laser][kind] or 0).to_bytes(2, "little")
        if laser in LASERS and register in (*range(0x20, 0x23), *range(0x28, 0x2B), *range(0x30, 0x33)):
            return self.built_for[laser][kind if register < 0x30 else 2].to_bytes(2, "little")
        raise NackError

    def stop(self) -> None:
        """The pointer holds for one transfer only."""
        self._pointer = None
