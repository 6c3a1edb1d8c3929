"""A laser board in virtual time, behind the real smbus2, and the lasers on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import smbus2
from hypothesis import strategies as st

from firmware_iface.lasers import VIRTUAL_CHANNELS, Lasers
from firmware_iface.virtual.i2c import LaserBoard, attach, detach

Emission = Callable[[float, dict[str, float]], None]

WINDOW_S, TICK_S = 0.100, 0.001  # of the safety controller: without a heartbeat, and between looks
NAMES = [c.name for c in VIRTUAL_CHANNELS]
LASER = st.sampled_from([0, 1, 2])


class Bench:
    """A board, the bus to it, and a clock that only `pass_time` moves; while it moves, the board settles each ms.

    Attributes: board, bus (smbus2.SMBus), seen ((time s, {laser: µW}) of every change of light).
    """

    def __init__(self) -> None:
        self.now = 100.0
        self.seen: list[tuple[float, dict[str, float]]] = []
        self.board = LaserBoard(clock=lambda: self.now, emission=lambda *change: self.seen.append(change))
        self.board.bus.sleep = self.pass_time
        self.node = attach(self.board.bus)
        self.bus = smbus2.SMBus(self.node)

    def pass_time(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(self.now + 0.001, end)
            self.board.settle()

    def ready(self) -> None:
        self.board.key = self.board.interlock = True

    def open(self) -> Lasers:
        return Lasers(smbus2.SMBus(self.node), VIRTUAL_CHANNELS, lambda: self.now, self.pass_time)

    def armed(self) -> Lasers:
        self.ready()
        lasers = self.open()
        lasers.arm()
        return lasers

    @property
    def light_uw(self) -> float:
        return sum(self.board.emitted_uw.values())

    @contextmanager
    def recorded(self) -> Iterator[list[str]]:
        """The transfers meanwhile: 'ADDRESS R|W BYTES'."""
        transcript: list[str] = []
        self.board.bus.transcript, self.board.bus.record = transcript, True
        try:
            yield transcript
        finally:
            self.board.bus.record = False

    def close(self) -> None:
        self.bus.close()
        detach(self.node)
