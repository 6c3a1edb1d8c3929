"""The lasers' driver over a bus that fails at random, with parts and programs that fail, too."""

from __future__ import annotations

from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    precondition,
    rule,
)

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers import VIRTUAL_CHANNELS, Lasers
from tests.firmware_iface.lasers.boards import NAMES, TICK_S, WINDOW_S, Bench


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
            assert time_s - self.lasers._heartbeat.at < WINDOW_S + 0.3, "no heartbeat was even tried"
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
