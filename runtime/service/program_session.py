"""The session of one connected program: its version, its ring and its frames."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from firmware_iface.errors import InputError
from runtime.service import protocol
from runtime.service.frame_calls import FrameCalls, OrderError
from runtime.service.protocol import Code, Error
from runtime.service.shared_memory import Ring, open_ring
from runtime.service.socket_link import MessageLink


class RequestError(Exception):
    """A request that has to be answered by Error."""

    def __init__(self, code: Code, text: str) -> None:
        super().__init__(text)
        self.code, self.text = code, text


@dataclass(frozen=True)
class FrameJob:
    """An accepted frame without an outcome yet.

    Attributes
    ----------
    job : int
        Number of the job.
    session : Session
        The program that sent the frame.
    frame : int
        Number of the frame in its session.
    slot : int
        Slot of the picture in the program's ring.
    crc : int
        CRC-32 of the picture.
    display_ns, accepted_ns : int, ns
        When the frame is to be displayed and when it was accepted (CLOCK_MONOTONIC).
    """

    job: int
    session: Session
    frame: int
    slot: int
    crc: int
    display_ns: int
    accepted_ns: int


class Session:
    """The session of a connected program.

    Attributes
    ----------
    version : int or None
        Version of the protocol; None before Hello.
    ring : Ring or None
        Pictures of the program that has the display.
    slots : int
        Slots of the ring.
    calls : FrameCalls
        Order of the frame calls.
    waiting : int or None
        Serial of a Wait that is not answered yet.
    display_ns : int, ns
        Display time of the latest frame given (CLOCK_MONOTONIC).
    closed : bool
        The session has ended and has to be removed.
    """

    def __init__(self, link: MessageLink) -> None:
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
        """Send; end the session where the program has disconnected or does not read."""
        if self.closed:
            return
        try:
            self.link.send(message, serial, [] if fd is None else [fd])
        except OSError:
            self.closed = True

    def hello(self, message: protocol.Hello) -> None:
        """Agree on a version.

        Raises
        ------
        RequestError
            Where there is no common version.
        """
        if message.magic != protocol.MAGIC or self.version is not None:
            raise RequestError(Code.MALFORMED, "Hello comes once, first, with the magic 'hololoop'")
        self.version = protocol.agreed_version(message)
        if self.version is None:
            raise RequestError(
                Code.VERSION,
                f"the program supports versions {message.lowest} to {message.highest} and the service "
                f"{protocol.LOWEST} to {protocol.HIGHEST}: use a client library of the service's release",
            )

    def take_ring(self, message: protocol.Ring, fd: int | None, shape: tuple[int, ...]) -> None:
        """Check and map the program's ring. The session owns `fd` from now on.

        Raises
        ------
        RequestError
            Where the ring cannot be used; `fd` is then closed.
        """
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
        """The program waits for its next frame.

        Raises
        ------
        RequestError
            Out of order.
        """
        with self._in_order():
            self.calls.check_wait()
        if self.waiting is not None:
            raise RequestError(Code.ORDER, "a Wait is not answered yet")
        self.waiting = serial

    def next_frame(self, display_ns: int) -> int:
        """The number of the next frame, which is to be displayed at `display_ns`."""
        frame = self.calls.wait()
        self.display_ns = display_ns
        recent = {f: at for f, at in self._displays.items() if f >= frame - 1}
        self._displays = recent | {frame: display_ns}
        return frame

    def begin(self, frame: int) -> None:
        """Drawing begins.

        Raises
        ------
        RequestError
            Out of order.
        """
        with self._in_order():
            self.calls.begin(frame)

    def end(self, message: protocol.End) -> int:
        """The frame is drawn; returns when it is to be displayed (CLOCK_MONOTONIC, ns).

        Raises
        ------
        RequestError
            Out of order.
        """
        with self._in_order():
            if message.slot >= self.slots:
                raise RequestError(Code.SLOT, f"there is no slot {message.slot}: the ring has {self.slots}")
            self.calls.end(message.frame, message.slot)
        return self._displays[message.frame]

    @contextmanager
    def _in_order(self) -> Iterator[None]:
        """Turns an OrderError into a RequestError."""
        if self.ring is None:
            raise RequestError(Code.ORDER, "send Ring before frame calls")
        try:
            yield
        except OrderError as error:
            raise RequestError(Code.ORDER, str(error)) from None

    def fail(self, frame: int, code: Code, text: str) -> None:
        """An accepted frame cannot be shown."""
        self.calls.settle(frame)
        self.send(Error(code, frame, text))

    def close(self) -> None:
        """Close the connection and the ring."""
        self.closed = True
        self.link.close()
        if self.ring is not None:
            self.ring.close()
            self.ring = None
