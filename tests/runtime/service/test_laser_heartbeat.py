"""The lasers' thread with a simulated board: what makes it dark, and the power that it allows for a pattern."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers.eye_safety import SIZES_MRAD
from runtime.service.laser_heartbeat import LaserHeartbeat
from runtime.service.protocol import LaserState
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("real_time")  # its thread needs its share of the cores

SHARES = tuple(0.02 + 0.001 * (k + 1) for k in range(len(SIZES_MRAD)))


class Board:
    """Records its calls; fails as the test sets it."""

    def __init__(self) -> None:
        self.calls: list[Any] = []
        self.state, self.level, self.fails = "off", 0.0, ""
        self.allowed = 1.0

    def _do(self, what: str) -> None:
        if self.fails == what:
            self.trip()
            raise DeviceError(f"{what} failed")
        if what not in ("status", "heartbeat"):
            self.calls.append(what)

    def open(self) -> Board:
        self._do("open")
        return self

    def heartbeat(self) -> None:
        self._do("heartbeat")

    def clear(self) -> None:
        self._do("clear")
        self.state = "off"

    def arm(self) -> None:
        self._do("arm")
        self.state = "armed"

    def trip(self) -> None:
        self.calls.append("trip")
        self.state, self.level = "fault", 0.0

    def off(self) -> None:
        self._do("off")
        self.level = 0.0

    def close(self) -> None:
        self.calls.append("close")
        self.state, self.level = "off", 0.0

    def expect(self, shares: Any) -> float:
        self.calls.append(shares)
        self.allowed = 0.2 if shares["green"][0] > 0.1 else 1.0
        self.level = min(self.level, self.allowed)
        return 1.0

    def power(self, channel: str) -> float:
        return self.level

    def ramp(self, channel: str, fraction: float) -> Iterator[None]:
        if fraction > self.allowed:
            raise InputError("more than the budget of this pattern")
        for step in range(1, 5):
            self.level = fraction * step / 4
            yield

    def status(self) -> dict[str, Any]:
        self._do("status")
        return {
            "state": self.state,
            "faults": ["host"] if self.state == "fault" else [],
            "power": {"green": self.level},
        }


class Bench:
    def __init__(self) -> None:
        self.board, self.faults = Board(), []
        self.solver_until = self.lit_until = time.monotonic_ns() + 10**12
        self.lasers = LaserHeartbeat(
            self.board.open,
            {"green": 0.5},
            lambda: {"solver": self.solver_until},
            lambda: self.lit_until,
            lambda kind, text: self.faults.append(kind),
        )

    def ask(self, what: str) -> str | None:
        answers: list[str | None] = []
        self.lasers.ask(what, answers.append)
        until(lambda: answers)
        return answers[0]

    def light_up(self) -> None:
        assert self.ask("clear") is None and self.ask("arm") is None
        until(lambda: self.board.level == 0.5)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.lasers.start()
    yield bench
    bench.lasers.stop()


def test_nothing_is_armed_without_clear_and_what_was_cleared_is_armed_once(bench: Bench) -> None:
    assert "Clear first" in (bench.ask("arm") or "")
    bench.light_up()
    assert bench.ask("dark") is None
    assert "Clear first" in (bench.ask("arm") or "") and bench.board.level == 0


def test_a_part_without_a_sign_of_life_latches(bench: Bench) -> None:
    bench.light_up()
    bench.solver_until = 0
    until(lambda: bench.lasers.state == LaserState.FAULT)
    assert bench.board.calls[-1] == "trip" and bench.faults == ["silent"]
    assert bench.ask("clear") is None and "solver" in (bench.ask("arm") or "")
    bench.solver_until = time.monotonic_ns() + 10**12
    bench.light_up()


def test_a_stale_pattern_is_not_lit_and_nothing_latches(bench: Bench) -> None:
    bench.light_up()
    bench.lit_until = 0
    until(lambda: bench.board.level == 0)
    assert bench.lasers.state == LaserState.ARMED and bench.faults == []
    bench.lit_until = time.monotonic_ns() + 10**12
    until(lambda: bench.board.level == 0.5)


@pytest.mark.parametrize("what", ["heartbeat", "off"])
def test_a_board_that_fails_is_not_lit_again_by_itself(bench: Bench, what: str) -> None:
    bench.light_up()
    bench.board.fails = what
    bench.lit_until = 0
    until(lambda: bench.lasers.state == LaserState.FAULT)
    bench.board.fails, bench.lit_until = "", time.monotonic_ns() + 10**12
    time.sleep(0.1)
    assert bench.board.level == 0 and bench.faults == ["lasers"]
    bench.light_up()


def test_a_board_that_does_not_answer_is_opened_again(bench: Bench) -> None:
    bench.light_up()
    bench.board.fails = "status"
    assert bench.ask("dark") is None  # the board went dark; that its state is unknown is found later
    until(lambda: bench.lasers.state == LaserState.LOST)
    bench.board.fails = ""
    until(lambda: bench.lasers.state == LaserState.OFF)
    bench.light_up()


def test_a_missing_board_is_one_fault_until_it_is_back(bench: Bench) -> None:
    until(lambda: bench.lasers.state == LaserState.OFF)
    for outages in (1, 2):
        bench.board.fails = "status"
        until(lambda: bench.lasers.state == LaserState.LOST)
        time.sleep(0.2)  # several attempts
        assert bench.faults == outages * ["laser_bus"]
        bench.board.fails = ""
        until(lambda: bench.lasers.state == LaserState.OFF)


def test_a_pattern_waits_for_the_power_that_its_bright_spots_allow(bench: Bench) -> None:
    bench.light_up()
    shown: list[str] = []
    bench.lasers.expect(struct.pack("<13f", *SHARES), lambda: shown.append("pattern"))
    until(lambda: shown)
    assert bench.board.calls[-1] == {"green": pytest.approx(SHARES)}
    count = len(bench.board.calls)
    bench.lasers.expect(bytes(52), lambda: shown.append("unpredicted"))
    assert shown[-1] == "unpredicted" and len(bench.board.calls) == count


def test_power_that_a_bright_spot_lowered_comes_back_when_a_pattern_allows_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.service.laser_heartbeat.RISE_AGAIN_S", 0.05)
    bench.light_up()
    bench.lasers.expect(struct.pack("<13f", *(10 * s for s in SHARES)), lambda: None)
    until(lambda: "budget" in bench.faults)
    assert bench.board.level == pytest.approx(0.2) and bench.lasers.state == LaserState.EMITTING
    bench.lasers.expect(struct.pack("<13f", *SHARES), lambda: None)
    until(lambda: bench.board.level == 0.5)


def test_the_end_is_dark(bench: Bench) -> None:
    bench.light_up()
    bench.lasers.stop()
    assert bench.board.calls[-1] == "close" and bench.board.level == 0
