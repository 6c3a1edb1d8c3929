"""No reachable state emits without key, interlock, heartbeat and freedom from fault, or above a ceiling.

Two machines drive the emulated board through random sequences. One is a hostile host: it writes what it likes to every
part. The other uses the driver, over a bus that fails at random. What must hold is judged from what was done to the
board, by a record of its own, never from what the controller's model says of itself.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import smbus2
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers import VIRTUAL_CHANNELS, Lasers
from firmware_iface.lasers.safety_controller import packet_error_code
from firmware_iface.virtual.i2c import safety_controller as model
from tests.firmware_iface.lasers.boards import Bench

WINDOW_S, TICK_S = 0.100, 0.001
NAMES = [c.name for c in VIRTUAL_CHANNELS]
LASER = st.sampled_from([0, 1, 2])


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


class FailingBus(RuleBasedStateMachine):
    """The driver, as a program uses it, while the bus, the board and the program fail."""

    def __init__(self) -> None:
        super().__init__()
        self.bench = Bench()
        self.bench.ready()
        self.lasers: Lasers | None = None
        self.hung_until = 0.0
        self.bench.board.bus.sleep = self.hang
        self.bench.board._emission = self.judge

    def teardown(self) -> None:
        self.bench.close()

    def hang(self, seconds: float) -> None:
        self.bench.pass_time(seconds)
        if self.bench.now > self.hung_until:
            self.bench.board.bus.faults.clear("hang")

    def judge(self, time_s: float, power_uw: dict[str, float]) -> None:
        board = self.bench.board
        if any(power_uw.values()):
            assert board.key and board.interlock and board.celsius <= 45
            assert self.lasers is not None, "no program, no light"
            assert time_s - self.lasers._beat_at < WINDOW_S + 0.3, "no heartbeat was even tried"
            for c in VIRTUAL_CHANNELS:
                assert power_uw[c.name] <= c.full_power_uw + 1e-6
            used = sum(power_uw.values()) / 390
            assert used <= 1, "above Class 1"

    def use(self, act: str, *given: object) -> None:
        if self.lasers is None:
            return
        try:
            getattr(self.lasers, act)(*given)
            assert act != "off" or self.bench.light_uw == 0, "off, and light"
        except InputError:
            return
        except DeviceError:
            if act not in ("arm", "clear", "set_power") or self.lasers._fractions == [0.0] * 3:
                dark_at = self.bench.now + WINDOW_S
                self.bench.pass_time(max(0.0, dark_at - self.bench.now) + TICK_S)
                assert self.bench.light_uw == 0, "a fault was reported, and there is light a window later"

    @rule()
    def open(self) -> None:
        if self.lasers is None:
            try:
                self.lasers = self.bench.open()
            except DeviceError:
                assert self.bench.light_uw == 0

    @rule()
    def light(self) -> None:
        """All that it takes; one rule, so that faults meet light often."""
        self.open()
        self.use("clear")
        self.use("arm")
        self.use("set_power", "green", 0.7)

    @rule(channel=st.sampled_from(NAMES), fraction=st.sampled_from([0.0, 0.2, 1.0]))
    def set_power(self, channel: str, fraction: float) -> None:
        self.use("set_power", channel, fraction)

    @rule(steps=st.integers(1, 19), act=st.sampled_from(["off", "trip", "heartbeat", "close"]))
    def change_of_mind(self, steps: int, act: str) -> None:
        """Something comes between the steps of a ramp; what darkens stays dark through the others."""
        if self.lasers is None:
            return
        dark = False
        try:
            for step, _ in enumerate(self.lasers.ramp("red", 1.0)):
                self.bench.pass_time(0.005)
                if step == steps:
                    getattr(self.lasers, act)()
                    dark = act in ("off", "trip") and not self.bench.board.bus.faults.struck
                assert not (dark and self.bench.light_uw)
        except DeviceError:
            pass
        if act == "close":
            self.end(killed=False)

    @rule(act=st.sampled_from(["arm", "clear", "off", "status", "trip"]))
    def call(self, act: str) -> None:
        self.use(act)

    @rule(beats=st.integers(1, 5), seconds=st.sampled_from([0.003, 0.02, 0.045, 0.12]))
    def show(self, beats: int, seconds: float) -> None:
        for _ in range(beats):
            self.bench.pass_time(seconds)
            self.use("heartbeat")

    @rule(
        kind=st.sampled_from(["nack", "timeout", "stall", "short_write", "garbage", "late", "unplug"]),
        count=st.integers(1, 3),
        after=st.integers(0, 20),
    )
    def fault(self, kind: str, count: int, after: int) -> None:
        self.bench.board.bus.faults.arm(kind, count, after)

    @rule(seconds=st.sampled_from([0.05, 0.3]), after=st.integers(0, 20))
    def hanging(self, seconds: float, after: int) -> None:
        self.hung_until = self.bench.now + seconds
        self.bench.board.bus.faults.arm("hang", None, after)

    @rule(key=st.booleans(), interlock=st.booleans(), celsius=st.sampled_from([25.0, 25.0, 50.0]))
    def surroundings(self, key: bool, interlock: bool, celsius: float) -> None:
        self.bench.board.key, self.bench.board.interlock, self.bench.board.celsius = key, interlock, celsius

    @rule()
    def repair(self) -> None:
        self.bench.board.bus.faults.clear()
        self.surroundings(True, True, 25.0)

    @precondition(lambda self: self.lasers is not None)
    @rule(killed=st.booleans())
    def end(self, killed: bool) -> None:
        """The program ends: it closes the lasers, or it is killed."""
        assert self.lasers is not None
        if killed:
            self.lasers._closed = True
            self.bench.pass_time(WINDOW_S + TICK_S)
        else:
            self.lasers.close()
            if not self.bench.board.bus.faults.struck:
                assert self.bench.light_uw == 0
            self.bench.pass_time(WINDOW_S + TICK_S)
        assert self.bench.light_uw == 0
        self.lasers = None


def test_a_hostile_host_gets_no_light_that_it_should_not() -> None:
    before = Judge.emitting
    run_state_machine_as_test(
        HostileHost, settings=settings(max_examples=150, stateful_step_count=30, deadline=None)
    )
    assert Judge.emitting - before > 2000, "the board hardly ever emitted, so little was judged"


def constant(name: str, value: object) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setattr(model, name, value)


def ceiling_again(patch: pytest.MonkeyPatch) -> None:
    def set_ceiling(self: model.SafetyController, kind: int, laser: int, value: int) -> None:
        self.ceilings[laser][kind] = value

    patch.setattr(model.SafetyController, "_set_ceiling", set_ceiling)


def deaf_to(fault: model.Fault) -> Callable[[pytest.MonkeyPatch], None]:
    latch = model.SafetyController._latch

    def breaks(patch: pytest.MonkeyPatch) -> None:
        patch.setattr(
            model.SafetyController, "_latch", lambda self, f: latch(self, f & ~fault) if f & ~fault else None
        )

    return breaks


def gate_of_arming_alone(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(model.SafetyController, "gate", property(lambda self: self.armed))
    patch.setattr(model.SafetyController, "_watch", lambda self: None)


def no_limiter(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(model.SafetyController, "output_v", lambda self, laser: self._wiring.requested_v(laser))


@pytest.mark.parametrize(
    "breaks",
    [
        constant("WINDOW_S", 0.15),
        constant("RISE_TICKS", 25),
        constant("pec", lambda data: 0x00),
        ceiling_again,
        deaf_to(model.Fault.HEARTBEAT),
        pytest.param(deaf_to(model.Fault.INTERLOCK), marks=pytest.mark.slow),
        deaf_to(model.Fault.HOST),
        deaf_to(model.Fault.OVERPOWER_0 | model.Fault.OVERPOWER_1 | model.Fault.OVERPOWER_2),
        deaf_to(model.Fault.BUS),
        gate_of_arming_alone,
        no_limiter,
    ],
    ids=[
        "window",
        "rise",
        "code",
        "ceiling",
        "heartbeat",
        "interlock",
        "host",
        "overpower",
        "bus",
        "gate",
        "limiter",
    ],
)
def test_the_judge_sees_a_controller_that_is_broken(
    breaks: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    breaks(monkeypatch)
    with pytest.raises(AssertionError):
        run_state_machine_as_test(
            HostileHost,
            settings=settings(
                max_examples=2000,
                stateful_step_count=30,
                deadline=None,
                derandomize=True,
                phases=[Phase.generate],
                report_multiple_bugs=False,
            ),
        )


def test_no_failure_of_bus_board_or_program_leaves_light() -> None:
    run_state_machine_as_test(
        FailingBus, settings=settings(max_examples=60, stateful_step_count=30, deadline=None)
    )


@pytest.mark.slow
@pytest.mark.parametrize("machine", [HostileHost, FailingBus])
def test_the_same_for_long(machine: type[RuleBasedStateMachine]) -> None:
    run_state_machine_as_test(
        machine, settings=settings(max_examples=1000, stateful_step_count=50, deadline=None)
    )
