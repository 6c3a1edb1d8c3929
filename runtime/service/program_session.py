"""One program's connection: its version, its ring, its frames."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from firmware_iface.errors import InputError
from runtime.service import protocol
from runtime.service.frames import FrameCalls, OrderError
from runtime.service.link import Link
from runtime.service.protocol import Code, Error
from runtime.service.ring import Ring, open_ring


class RequestError(Exception):
    """A request that is answered by Error."""

    def __init__(self, code: Code, text: str) -> None:
        super().__init__(text)
        self.code, self.text = code, text


@dataclass(frozen=True)
class FrameJob:
    """An accepted frame on its way: whose, where its picture is, when it is to be seen (CLOCK_MONOTONIC, ns)."""

    job: int
    session: Session
    frame: int
    slot: int
    crc: int
    display_ns: int
    accepted_ns: int


class Session:
    """A program that is connected.

    Attributes: version (None before Hello), ring (of the one that has the display), calls, waiting (serial of
    a Wait that is not answered yet), display_ns (of the latest frame given), closed (the program is to go)
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.version: int | None = None
        self.ring: Ring | None = None
        self.slots = 0
        self.calls = FrameCalls()
        self.waiting: int | None = None
        self.display_ns = 0
        self._displays: dict[int, int] = {}
        self.closed = False

    def send(self, message: NamedTuple, serial: int = 0, fd: int | None = None) -> None:
        """Send, or give the session up where the program is gone or does not read."""
        if self.closed:
            return
        try:
            self.link.send(message, serial, [] if fd is None else [fd])
        except OSError:
            self.closed = True

    def hello(self, message: protocol.Hello) -> None:
        """Agree on a version. Raises RequestError where there is none."""
        if message.magic != protocol.MAGIC or self.version is not None:
            raise RequestError(Code.MALFORMED, "Hello comes once, first, with the magic 'hololoop'")
        self.version = protocol.agreed_version(message)
        if self.version is None:
            raise RequestError(
                Code.VERSION,
                f"the program speaks versions {message.lowest} to {message.highest} and the service "
                f"{protocol.LOWEST} to {protocol.HIGHEST}: use a client library of the service's release",
            )

    def take_ring(self, message: protocol.Ring, fd: int | None, shape: tuple[int, ...]) -> None:
        """Check and map the program's ring; takes the descriptor over. Raises RequestError."""
        slot_bytes = 2 * int(np.prod(shape))
        fits = 1 <= message.slots <= protocol.MOST_SLOTS and message.slot_bytes == slot_bytes
        if fd is None or self.ring is not None or not fits:
            if fd is not None:
                os.close(fd)
            raise RequestError(
                Code.RING,
                f"send one ring, with its memfd, of 1 to {protocol.MOST_SLOTS} slots of {slot_bytes} bytes",
            )
        try:
            self.ring = open_ring(fd, message.slots, shape, np.uint16)
        except (InputError, OSError, ValueError) as error:
            raise RequestError(Code.RING, str(error)) from None
        self.slots = message.slots

    def wait(self, serial: int) -> None:
        """The program waits for its next frame. Raises RequestError out of order."""
        with self._in_order():
            self.calls.check_wait()
        if self.waiting is not None:
            raise RequestError(Code.ORDER, "a Wait is not answered yet")
        self.waiting = serial

    def next_frame(self, display_ns: int) -> int:
        """The number of the frame that is to be seen then."""
        frame = self.calls.wait()
        self.display_ns = display_ns
        recent = {f: at for f, at in self._displays.items() if f >= frame - 1}
        self._displays = recent | {frame: display_ns}
        return frame

    def begin(self, frame: int) -> None:
        """Drawing begins. Raises RequestError out of order."""
        with self._in_order():
            self.calls.begin(frame)

    def end(self, message: protocol.End) -> int:
        """The frame is drawn; returns when it is to be seen. Raises RequestError out of order."""
        with self._in_order():
            if message.slot >= self.slots:
                raise RequestError(Code.SLOT, f"there is no slot {message.slot}: the ring has {self.slots}")
            self.calls.end(message.frame, message.slot)
        return self._displays[message.frame]

    @contextmanager
    def _in_order(self) -> Iterator[None]:
        """Turns a frame call out of order into the answer to it."""
        if self.ring is None:
            raise RequestError(Code.ORDER, "send Ring before frame calls")
        try:
            yield
        except OrderError as error:
            raise RequestError(Code.ORDER, str(error)) from None

    def fail(self, frame: int, code: Code, text: str) -> None:
        """An accepted frame came to nothing."""
        self.calls.settle(frame)
        self.send(Error(code, frame, text))

    def close(self) -> None:
        """Close the connection and the ring."""
        self.closed = True
        self.link.close()
        if self.ring is not None:
            self.ring.close()
            self.ring = None
