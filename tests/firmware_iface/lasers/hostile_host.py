"""A hostile host that writes what it likes to every part of the emulated laser board, and a judge of what that gives.

The judge keeps a record of its own of what was done to the board, and never asks what the controller's model says.
"""

from __future__ import annotations

import smbus2
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
)

from firmware_iface.lasers.safety_controller import packet_error_code
from tests.firmware_iface.lasers.boards import LASER, NAMES, TICK_S, WINDOW_S, Bench


class Judge:
    """The record of what happened to a board, and the verdict on every change of its light."""

    emitting = 0  # changes of light that were judged, over all boards

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.beat_at = -1.0
        self.token: int | None = None
        self.cleared = True  # since the last event that must latch
        self.half_armed = self.armed = False
        self.ceilings: list[list[int | None]] = [[None, None] for _ in range(3)]
        self.nominal_since = -1.0
        self.judged_at, self.before = bench.now, dict.fromkeys(NAMES, 0.0)
        self.slowest = [0.0] * 3  # the light, had it risen as slowly as it must
        bench.board._emission = self.judge

    def trip(self) -> None:
        """Something happened that must be dark until CLEAR and ARM; where nothing was armed, ARM is refused."""
        self.cleared = not self.armed and self.cleared
        self.armed = self.half_armed = False

    def latch(self) -> None:
        """As `trip`, but latched whether or not it was armed."""
        self.trip()
        self.cleared = False

    def reset(self) -> None:
        """Power was off."""
        self.beat_at, self.token = -1.0, None
        self.cleared, self.half_armed, self.armed = True, False, False
        self.ceilings = [[None, None] for _ in range(3)]

    def silence(self) -> None:
        """Note a heartbeat that has been missing."""
        if self.armed and self.bench.now - self.beat_at > WINDOW_S + 1e-6:
            self.trip()

    def nominal(self) -> bool:
        """Whether the diodes have done what they are calibrated for, for a tick at least."""
        return all(d.offset_ma == 0 and d.efficiency == 1 for d in self.bench.board.diodes)

    def judge(self, time_s: float, power_uw: dict[str, float]) -> None:
        """Called at every change of light."""
        self.conditions(time_s, power_uw)
        board = self.bench.board
        for k, diode in enumerate(board.diodes):
            drive, photodiode = self.ceilings[k]
            power = power_uw[diode.name]
            if power == 0:
                self.slowest[k] = 0.0
                continue
            assert drive is not None and photodiode is not None, "a ceiling was never written"
            limit = 4.0 if k < 2 else 1.0
            highest = limit * max(0.0, 50 * drive * 1e-4 - (45, 40, 30)[k])
            if self.nominal():
                assert power <= highest + 1e-6, "above its ceiling"
                risen = self.slowest[k] + highest * (time_s - self.judged_at) / 0.050
                lowest = min(risen, self.before[diode.name])
                assert power <= lowest + 2 * highest * TICK_S / 0.050 + 1e-6, "faster than 50 ms"
                self.slowest[k] = min(power, lowest)
            else:
                self.slowest[k] = power
        self.judged_at, self.before = time_s, dict(power_uw)

    def conditions(self, time_s: float, power_uw: dict[str, float]) -> None:
        """What must hold while there is light."""
        if not any(power_uw.values()):
            return
        Judge.emitting += 1
        board = self.bench.board
        assert board.key and board.interlock, "without key or interlock"
        assert time_s - self.beat_at < WINDOW_S, "without heartbeat"
        assert self.armed and self.cleared, "not armed in two steps since the last fault"

    def settle(self) -> None:
        """What must hold at any time, and that light too bright for its photodiode's ceiling lasts a tick at most."""
        board = self.bench.board
        self.silence()
        self.conditions(self.bench.now, board.emitted_uw)
        for k in range(3):
            seen = board.power_uw(k) * board.diodes[k].photodiode_v_per_uw
            assert seen <= (self.ceilings[k][1] or 0) * 1e-4 + 1e-9


class HostileHost(RuleBasedStateMachine):
    """Raw bytes to every part, right and wrong ones."""

    def __init__(self) -> None:
        super().__init__()
        self.bench = Bench()
        self.judge = Judge(self.bench)

    def teardown(self) -> None:
        self.bench.close()

    def send(self, address: int, *data: int) -> bool:
        try:
            self.bench.bus.i2c_rdwr(smbus2.i2c_msg.write(address, data))
        except OSError:
            return False
        return True

    def register(self, register: int, *value: int, wrong: int = 0) -> bool:
        code = packet_error_code(bytes([0x36 << 1, register, *value]))
        return self.send(0x36, register, *value, code ^ wrong)

    def beat(self, token: int) -> None:
        judge, now = self.judge, self.bench.now
        judge.silence()
        good = token != judge.token and now - judge.beat_at >= 0.005 - 1e-9
        if not good:
            judge.trip()
        before = judge.armed
        judge.token, judge.beat_at = (token, now) if good else (None, -1.0)
        self.register(0x06, token)
        if not good:
            judge.beat_at = -1.0
            self.bench.pass_time(0.005)  # the board measures "too soon" from any token
        assert judge.armed == before

    @initialize(ready=st.booleans())
    def start(self, ready: bool) -> None:
        if ready:
            self.arm_properly()

    @rule()
    def arm_properly(self) -> None:
        """The right way; random bytes would never find it."""
        judge = self.judge
        if any(c is not None and c < 9000 for pair in judge.ceilings for c in pair):
            self.power_cycle()
        self.temperature(30.0)
        self.diodes_as_built()
        self.send(0x49, 0x01, 0x00, 0x02)  # the thermometer as after power-on, but for its limit
        self.send(0x49, 0x02, 0x16, 0x80)
        self.send(0x48, 0x01, 0x04, 0x83)  # the comparator off
        for name in ("key", "interlock"):
            self.switch(name, True)
        self.send(0x60, *bytes(8))
        for k, volts in enumerate((15000, 13000, 9000)):
            for kind in (0, 1):
                if judge.ceilings[k][kind] is None:
                    self.ceiling(k, kind, volts if kind == 0 else 12000)
        self.bench.pass_time(0.006)
        judge.silence()
        self.beat((judge.token or 0) % 255 + 1)
        for command in (0xC3, 0xA5, 0x5A):
            self.command(command)
        self.send(0x20, 0x0A, 0x07)
        self.send(0x20, 0x00, 0xF8)

    @rule(data=st.data())
    def show(self, data: st.DataObject) -> None:
        """A proper host for a while: light is on, and what comes next hits a board that emits."""
        if not self.judge.armed and data.draw(st.integers(0, 3)):
            self.arm_properly()
        laser, code = data.draw(LASER), data.draw(st.sampled_from([1500, 2500, 4095]))
        self.send(0x60, 0x40 | laser << 1, 0x80 | code >> 8, code & 0xFF)
        for _ in range(data.draw(st.integers(1, 4))):
            self.time(data.draw(st.sampled_from([0.02, 0.02, 0.05, 0.099, 0.101, 0.12])))
            self.beat((self.judge.token or 0) % 255 + 1)
        what = data.draw(st.sampled_from(["nothing", "brighter", "noise", "jump", "blink", "host"]))
        if what == "brighter":
            self.diode(laser, 2.0, 0.0)
        elif what == "noise":
            self.wrong_code(0x06, b"x", 1)
        elif what == "blink":
            name = data.draw(st.sampled_from(["key", "interlock"]))
            self.switch(name, False)
            self.switch(name, True)
        elif what == "host":
            self.command(0xF0)
        elif what == "jump":
            self.send(0x60, *bytes(8))
            self.send(0x60, 0x40 | laser << 1, 0x8F, 0xFF)

    @rule(name=st.sampled_from(["key", "interlock"]), on=st.booleans())
    def switch(self, name: str, on: bool) -> None:
        if not on:
            self.judge.silence()
            self.judge.trip()
        setattr(self.bench.board, name, on)

    @rule(celsius=st.sampled_from([25.0, 44.0, 50.0]))
    def temperature(self, celsius: float) -> None:
        self.bench.board.celsius = celsius  # trips only where the host has set the limit, as it may not have
        if celsius > 45 and self.bench.board.thermometer.alert:
            self.judge.trip()

    @rule(seconds=st.sampled_from([0.0005, 0.003, 0.02, 0.06, 0.11]))
    def time(self, seconds: float) -> None:
        self.bench.pass_time(seconds)
        self.judge.silence()

    @rule(token=st.integers(0, 255))
    def token(self, token: int) -> None:
        self.beat(token)

    @rule(command=st.sampled_from([0x00, 0xC3, 0xA5, 0x5A, 0xF0, 0x01]))
    def command(self, command: int) -> None:
        judge = self.judge
        judge.silence()
        if command == 0x5A and judge.half_armed and judge.cleared:
            judge.armed = True  # it may be: the board knows more reasons against it
        judge.half_armed = command == 0xA5
        if command == 0xC3:
            judge.cleared = True
        elif command == 0xF0:
            judge.latch()
        elif command == 0x00:
            judge.armed = False
        self.register(0x05, command)

    @rule(
        laser=LASER,
        kind=st.sampled_from([0, 1]),
        value=st.sampled_from([0, 5000, 10000, 12000, 20000, 65535]),
    )
    def ceiling(self, laser: int, kind: int, value: int) -> None:
        highest = ((15000, 13000, 9000)[laser], 13000)[kind]
        fits = self.judge.ceilings[laser][kind] is None and value <= highest
        if fits:
            self.judge.ceilings[laser][kind] = value
        else:
            self.judge.latch()
        taken = self.register((0x10, 0x18)[kind] + laser, *value.to_bytes(2, "little"))
        assert taken == fits

    @rule(register=st.integers(0, 255), value=st.binary(max_size=3), wrong=st.integers(1, 255))
    def wrong_code(self, register: int, value: bytes, wrong: int) -> None:
        self.judge.latch()
        assert not self.register(register, *value, wrong=wrong)

    @rule(
        laser=LASER,
        flags=st.sampled_from([0x80, 0x90, 0x00, 0xA0]),
        code=st.sampled_from([0, 1, 1800, 3000, 4095]),
    )
    def dac(self, laser: int, flags: int, code: int) -> None:
        self.send(0x60, 0x40 | laser << 1, flags | code >> 8, code & 0xFF)

    @rule(address=st.sampled_from([0x00, 0x20, 0x48, 0x49, 0x60]), data=st.binary(max_size=10))
    def anything(self, address: int, data: bytes) -> None:
        self.send(address, *data)

    @rule(
        laser=LASER,
        efficiency=st.sampled_from([0.5, 1.0, 1.1, 2.0]),
        offset_ma=st.sampled_from([0.0, 2.0, 40.0]),
    )
    def diode(self, laser: int, efficiency: float, offset_ma: float) -> None:
        diode = self.bench.board.diodes[laser]
        self.bench.board.settle()
        diode.efficiency, diode.offset_ma = efficiency, offset_ma
        self.judge.before = {
            d.name: self.bench.board.power_uw(k) for k, d in enumerate(self.bench.board.diodes)
        }
        self.judge.slowest = list(self.judge.before.values())  # the laser changed, not what drives it
        self.bench.board.settle()
        self.bench.pass_time(TICK_S)

    def diodes_as_built(self) -> None:
        for laser in range(3):
            self.diode(laser, 1.0, 0.0)

    @rule()
    def power_cycle(self) -> None:
        self.judge.reset()
        self.bench.board.power_cycle()

    @invariant()
    def bright_light_does_not_last(self) -> None:
        self.judge.settle()
