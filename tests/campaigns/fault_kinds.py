"""Every kind of fault of the campaign: how it is made, whether it requires darkness, how it ends."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from runtime.service.client import LostFrame
from runtime.service.protocol import PROTOCOL, Begin, Code, Done, End
from tests.campaigns.headset import knock
from tests.campaigns.lane import Lane


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    Attributes
    ----------
    name : str
    weight : float
        Relative frequency.
    strike : callable
        Makes the fault; returns the time, monotonic s.
    dark : bool
        Light is not allowed after it.
    heal : callable
        Removes the cause.
    fields : bool
        It strikes a headset that shows colours in turn alone.
    shows : bool
        Whether the program shows pictures meanwhile; it would wait otherwise.
    """

    name: str
    weight: float
    strike: Callable[[Lane], float]
    dark: bool
    heal: Callable[[Lane], object] = lambda lane: None
    shows: bool = True
    fields: bool = False


def _part(part: str, kind: str, weight: float, dark: bool, count: int | None = 1) -> FaultKind:
    lasting = count is None
    return FaultKind(
        f"{part} {kind.replace('_', ' ')}",
        weight,
        lambda lane: lane.remote.break_part(part, kind, count),
        dark,
        lambda lane: lane.remote.repair(part),
        shows=not (part == "lasers" and lasting),
    )


def _field(kind: str, count: int, weight: float) -> FaultKind:
    """The link from the panel board to the panel fails for some fields: what is then lit must be right all the same."""
    return FaultKind(
        f"panel {kind.replace('_', ' ')}",
        weight,
        lambda lane: lane.remote.break_part("panel link", kind, count),
        False,
        lambda lane: lane.remote.repair("panel link"),
        fields=True,
    )


def _board(name: str, setting: str, bad: object, good: object, weight: float) -> FaultKind:
    return FaultKind(
        name,
        weight,
        lambda lane: lane.remote.set_to(setting, bad),
        True,
        lambda lane: lane.remote.set_to(setting, good),
    )


def _child(name: str, what: str, number: int, weight: float, dark: bool) -> FaultKind:
    return FaultKind(
        what,
        weight,
        lambda lane: lane.signal_child(name, number),
        dark,
        (lambda lane: lane.signal_child(name, signal.SIGCONT))
        if number == signal.SIGSTOP
        else lambda lane: None,
        shows=False,
    )


def _late_solver(lane: Lane) -> float:
    """The solver gets no time for four frames."""
    at = lane.signal_child("solver", signal.SIGSTOP)
    time.sleep(0.04)
    lane.signal_child("solver", signal.SIGCONT)
    return at


def _service_killed(lane: Lane) -> float:
    at = time.monotonic()
    lane.end_service(signal.SIGKILL)
    return at


def _service_again(lane: Lane) -> None:
    try:
        lane.client.status()
    except OSError:  # so the program knows that its frames under way are lost
        lane.service = lane.start_service()
        lane.reconnect()
        return
    raise AssertionError("a service that was killed answered")


def _service_stopped(lane: Lane) -> float:
    at = time.monotonic()
    lane.service.send_signal(signal.SIGSTOP)
    return at


def _program_ends(lane: Lane) -> float:
    at = time.monotonic()
    lane.client.close()
    return at


def _program_pauses(lane: Lane) -> float:
    return time.monotonic()


def _torn_slot(lane: Lane) -> float:
    """A slot that is not what End announced: the frame must be reported as torn, and never be displayed."""
    client, at = lane.client, time.monotonic()
    timing = client.wait()
    client._ask(Begin(timing.frame), Done)
    client.slot()[:] = lane.pictures[0]
    number = client._drawing
    assert number is not None
    client._taken[timing.frame], client._drawing = number, None
    client._ask(End(timing.frame, number, 0xDEAD), Done)
    lane.accepted += 1
    end = time.monotonic() + 2
    while time.monotonic() < end:
        for outcome in lane.take(0.1):
            if outcome.frame == timing.frame:
                assert isinstance(outcome, LostFrame) and outcome.code == Code.TORN
                return at
    raise AssertionError("a torn frame had no outcome")


def _garbage_program(lane: Lane) -> float:
    """Another program sends bytes that are no message."""
    at = time.monotonic()
    with suppress(OSError):
        knock(lane.file, [b"\xff" * 64, PROTOCOL.pack(Begin(1), 1)[:-1]])
    return at


KINDS = (
    _part("panel", "timeout", 8, False),
    _part("panel", "stall", 8, False),
    _part("panel", "short_write", 8, False),
    _part("panel", "garbage", 8, False),
    _part("panel", "late", 3, False),
    _part("panel", "hang", 3, True, None),
    _part("panel", "unplug", 4, True, None),
    _field("torn_field", 7, 8),
    _field("swapped_gate", 5, 8),
    _field("missing_field", 7, 8),
    _part("lasers", "nack", 6, True),
    _part("lasers", "timeout", 6, True),
    _part("lasers", "stall", 6, True),
    _part("lasers", "short_write", 6, True),
    _part("lasers", "garbage", 5, True, 6),
    _part("lasers", "late", 3, True),
    _part("lasers", "hang", 3, True, None),
    _part("lasers", "unplug", 4, True, None),
    _board("interlock opened", "interlock", False, True, 3),
    _board("key turned off", "key", False, True, 3),
    _board("photodiode cut", "photodiodes", False, True, 2),
    _board("laser three times too bright", "efficiency", 3.0, 1.0, 3),
    _part("camera", "timeout", 2, False),
    _part("camera", "late", 1.5, True),
    _part("camera", "garbage", 1.5, False),
    _part("camera", "hang", 1.5, True, None),
    _part("camera", "unplug", 1.5, True, None),
    _child("camera", "camera process killed", signal.SIGKILL, 0.7, True),
    _child("solver", "solver process killed", signal.SIGKILL, 0.7, True),
    _child("solver", "solver process hangs", signal.SIGSTOP, 1, True),
    FaultKind("late frames", 3, _late_solver, False),
    FaultKind("service killed", 0.4, _service_killed, True, _service_again, shows=False),
    FaultKind(
        "service hangs",
        1,
        _service_stopped,
        True,
        lambda lane: lane.service.send_signal(signal.SIGCONT),
        shows=False,
    ),
    FaultKind("program gone", 1, _program_ends, True, Lane.reconnect, shows=False),
    FaultKind("program pauses", 2, _program_pauses, True, shows=False),
    FaultKind("torn slot", 3, _torn_slot, False),
    FaultKind("garbage from a program", 3, _garbage_program, False),
)
