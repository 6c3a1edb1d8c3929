"""A client counts as silent only while the guard could have heard it."""

from __future__ import annotations

import json
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from firmware_iface.lasers import guard_process
from firmware_iface.lasers.guard_process import LEASE_S, Guard

pytestmark = pytest.mark.usefixtures("real_time")

LONG_S = 2 * LEASE_S


class SlowBoard:
    """Lasers on a board that takes long to arm."""

    channels = ("green",)

    def __init__(self) -> None:
        self.tripped = threading.Event()

    def arm(self) -> None:
        time.sleep(LONG_S)

    def trip(self) -> None:
        self.tripped.set()

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *given: None  # what else a board does takes no time here


@pytest.fixture
def guarded(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[SlowBoard, Callable[[str], dict[str, Any]]]]:
    """A board behind a guard, and what asks the guard and returns its answer."""
    board = SlowBoard()
    monkeypatch.setattr(guard_process, "open_lasers", lambda *given: board)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(10)
    guard = threading.Thread(target=Guard(theirs).run)
    guard.start()

    def ask(act: str, *given: Any) -> dict[str, Any]:
        ours.send(json.dumps({"do": act, "with": given}).encode())
        return dict(json.loads(ours.recv(65536)))

    try:
        ask("open", "bus", [], None)
        yield board, ask
    finally:
        ours.close()
        guard.join()
        theirs.close()


def test_a_client_that_waits_for_an_answer_is_not_silent(
    guarded: tuple[SlowBoard, Callable[[str], dict[str, Any]]],
) -> None:
    board, ask = guarded
    assert "result" in ask("arm")
    assert not board.tripped.wait(0.6 * LEASE_S)  # within its time, which began with the answer
    assert board.tripped.wait(10)


def test_a_request_that_waits_is_heard_before_its_client_counts_as_silent(
    guarded: tuple[SlowBoard, Callable[[str], dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy machine the guard itself may be what had no processor for 100 ms."""
    board, ask = guarded
    ask("arm")
    wait, stalled = select.select, threading.Event()

    def stall(*given: Any) -> Any:
        found = wait(*given)
        if not found[0] and not stalled.is_set():
            stalled.set()
            time.sleep(LONG_S)
        return found

    monkeypatch.setattr(guard_process.select, "select", stall)
    assert stalled.wait(10)
    assert "result" in ask("beat") and not board.tripped.is_set()
    assert board.tripped.wait(10)
