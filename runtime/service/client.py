"""The Python client: a program's connection to the service.

with connect("/run/hololoop/service.sock") as headset:
    headset.clear()
    headset.arm()
    while True:
        timing = headset.wait()
        headset.begin(timing)
        slot = headset.slot()
        slot[:] = picture_for(timing.display_ns)   # linear irradiance, uint16 [C, H, W]
        headset.end(timing)
        for outcome in headset.outcomes():
            ...
"""

from __future__ import annotations

import os
import select
import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from firmware_iface.errors import InputError
from runtime.service import protocol
from runtime.service.protocol import PROTOCOL, Code, Done, Error, Refined, Shown, State, Timing, Welcome
from runtime.service.shared_memory import Ring, crc32, make_ring, read_sealed
from runtime.service.socket_link import MessageLink


class RefusedError(InputError):
    """The service refused a request.

    Attributes
    ----------
    code : int
        The reason: a protocol.Code, or a number of a newer version.
    """

    def __init__(self, error: Error) -> None:
        super().__init__(error.text)
        self.code = error.code


class LostFrame(NamedTuple):
    """An accepted frame that was not shown."""

    frame: int
    code: int
    text: str


class Client:
    """A connection to the service, for one thread at a time; `connect` makes it.

    Attributes
    ----------
    welcome : Welcome
        Version of the protocol and properties of the display.
    shape : tuple of int
        (C, H, W) of a picture.
    slots : int
        Slots of the ring.
    refined : Refined or None
        Result of the last refinement; None while it continues.
    """

    def __init__(self, link: MessageLink, welcome: Welcome, slots: int, timeout_s: float) -> None:
        self._link, self.welcome, self.slots, self._timeout_s = link, welcome, slots, timeout_s
        self.shape = (welcome.channels, welcome.height, welcome.width)
        self._serial = 1
        self._ring: Ring | None = None
        self._taken: dict[int, int] = {}  # slot by frame
        self._drawing: int | None = None
        self._outcomes: deque[Shown | LostFrame] = deque()
        self.refined: Refined | None = None

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; frames that are on their way are not shown."""
        self._link.close()
        if self._ring is not None:
            self._ring.close()

    def fileno(self) -> int:
        """For selectors: readable when an outcome may have come."""
        return self._link.fileno()

    def status(self) -> State:
        """The state of the headset."""
        return self._ask(protocol.Status(), State)[0]

    def clear(self) -> None:
        """First step to light: forget a latched fault.

        Raises
        ------
        RefusedError
            While the cause of the fault remains.
        """
        self._ask(protocol.Clear(), Done)

    def arm(self) -> None:
        """Second step to light.

        Raises
        ------
        RefusedError
            Without `clear` before it.
        """
        self._ask(protocol.Arm(), Done)

    def dark(self) -> None:
        """Switch the lasers off at once, until `clear` and `arm`."""
        self._ask(protocol.Dark(), Done)

    def capture(self) -> np.ndarray:
        """A picture from the camera whose exposure began after this call: counts, uint16 [h, w]."""
        picture, fd = self._ask(protocol.Capture(), None)
        return read_sealed(fd, (picture.height, picture.width), np.uint16)

    def refine(self, captures: int = 24) -> None:
        """Refine the next frame's picture while frames with it are shown.

        `refined` has the result when the refinement has ended and `outcomes` was called.

        Parameters
        ----------
        captures : int
            Captures at most; 0 ends a refinement and goes back to the solver's own pattern.
        """
        self._ask(protocol.Refine(captures), Done)
        self.refined = None

    def wait(self) -> Timing:
        """The next frame, once it may begin."""
        if self._ring is None:
            self._open_ring()
        return self._ask(protocol.Wait(), Timing)[0]

    def begin(self, timing: Timing) -> None:
        """Drawing of the frame begins."""
        self._ask(protocol.Begin(timing.frame), Done)

    def slot(self) -> np.ndarray:
        """The array for the picture of the frame that was begun; waits for a free slot.

        Returns
        -------
        uint16 array [C, H, W]
            Linear irradiance, 65535 for the brightest.

        Raises
        ------
        InputError
            Where no slot becomes free in time.
        """
        if self._ring is None:
            self._open_ring()
        assert self._ring is not None
        until = time.monotonic() + self._timeout_s
        while self._drawing is None:
            free = set(range(self.slots)) - set(self._taken.values())
            if free:
                self._drawing = min(free)
            elif not self._receive(until):
                raise InputError(f"no slot became free within {self._timeout_s:g} s: ask for status()")
        return self._ring.slots[self._drawing]

    def end(self, timing: Timing) -> None:
        """The frame is drawn; from now on its slot belongs to the service."""
        slot = self.slot()
        assert self._drawing is not None
        self._taken[timing.frame] = self._drawing
        try:
            self._ask(protocol.End(timing.frame, self._drawing, crc32(slot)), Done)
        except BaseException:
            self._taken.pop(timing.frame, None)
            raise
        self._drawing = None

    def show(self, picture: np.ndarray) -> int:
        """Wait, begin, draw and end in one call; returns the frame's number."""
        timing = self.wait()
        self.begin(timing)
        self.slot()[:] = picture
        self.end(timing)
        return timing.frame

    def outcomes(self, timeout_s: float = 0.0) -> Iterator[Shown | LostFrame]:
        """Outcomes of accepted frames since the last call; waits at most `timeout_s` for the first."""
        until = time.monotonic() + timeout_s
        while self._receive(time.monotonic()):
            pass
        while not self._outcomes and self._receive(until):
            pass
        while self._outcomes:
            yield self._outcomes.popleft()

    @property
    def in_flight(self) -> set[int]:
        """Accepted frames without an outcome yet."""
        return set(self._taken)

    def _open_ring(self) -> None:
        ring = make_ring(self.slots, self.shape, np.uint16)
        self._ask(protocol.Ring(self.slots, ring.slots[0].nbytes), Done, [ring.fd])
        self._ring = ring

    def _ask(self, message: NamedTuple, answer: type | None, fds: list[int] | None = None) -> tuple[Any, Any]:
        """Send a request and receive messages until its answer."""
        serial = self._serial = self._serial % (2**32 - 1) + 1
        self._link.send(message, serial, fds or [])
        until = time.monotonic() + self._timeout_s
        while True:
            received = self._receive(until)
            if received is None:
                raise InputError(
                    f"the service did not answer {type(message).__name__} within {self._timeout_s:g} s"
                )
            answered, reply, fd = received
            if answered != serial:
                continue
            if isinstance(reply, Error):
                raise RefusedError(reply)
            if answer is not None and not isinstance(reply, answer):
                raise InputError(f"the service answered {type(message).__name__} by {type(reply).__name__}")
            return reply, fd

    def _receive(self, until: float) -> tuple[int, Any, int | None] | None:
        """One message, or None after the time `until`; notes outcomes."""
        if not select.select([self._link], [], [], max(0.0, until - time.monotonic()))[0]:
            return None
        serial, message, fd = self._link.receive()
        if serial == 0:
            if isinstance(message, Shown):
                self._taken.pop(message.frame, None)
                self._outcomes.append(message)
            elif isinstance(message, Refined):
                self.refined = message
            elif isinstance(message, Error):
                if message.frame == 0:
                    raise RefusedError(message)
                self._taken.pop(message.frame, None)
                self._outcomes.append(LostFrame(message.frame, message.code, message.text))
        return serial, message, fd


def connect(path: str | os.PathLike[str], slots: int = 3, timeout_s: float = 5.0) -> Client:
    """Connect to the service.

    Parameters
    ----------
    path : path
        The service's socket.
    slots : int
        Slots of the ring; with 3, one is drawn, one is solved and one waits.
    timeout_s : float, s
        Longest wait for any answer.

    Returns
    -------
    Client

    Raises
    ------
    InputError
        Where there is no service, where it supports no version that is supported here, or where it refuses.
    """
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    try:
        try:
            connection.connect(os.fspath(path))
        except OSError as error:
            raise InputError(
                f"there is no service at {path} ({error.strerror}): start hololoop-runtime serve"
            ) from None
        client = Client(MessageLink(connection, PROTOCOL), Welcome(0, 0, 0, 0, 0, 0, 0), slots, timeout_s)
        welcome, _ = client._ask(protocol.Hello(protocol.MAGIC, protocol.LOWEST, protocol.HIGHEST), Welcome)
        return Client(client._link, welcome, slots, timeout_s)
    except BaseException:
        connection.close()
        raise


__all__ = ["Client", "Code", "LostFrame", "RefusedError", "connect"]
