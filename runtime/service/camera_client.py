"""The supervisor's side of the camera's process: its signs of life, and pictures for programs."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from itertools import count

from runtime.service import inside, protocol
from runtime.service.children import Child
from runtime.service.configuration import Configuration
from runtime.service.event_loop import Loop
from runtime.service.faults import Faults
from runtime.service.messages import ProtocolError
from runtime.service.metrics import Metrics
from runtime.service.program_session import RequestError, Session
from runtime.service.protocol import Code, Error

Taken = Callable[[inside.Seen | None, int | None, str], None]  # a picture and its memfd, or None and why not


class Eye:
    """The camera, where the configuration has one.

    Attributes: there (whether it has), fresh_until_ns (0: it does not deliver)
    """

    def __init__(self, configuration: Configuration, loop: Loop, faults: Faults, metrics: Metrics) -> None:
        self.there = "camera" in configuration.devices
        self.fresh_until_ns = 0
        self._child = Child(
            "camera", "runtime.service.camera_process", str(configuration.file), inside.CAMERA
        )
        self._stale_ns = int(configuration.timing.stale_limit_ms * 1e6)
        self._loop, self._faults, self._metrics = loop, faults, metrics
        self._asked: dict[int, Taken] = {}
        self._serials = count(1)

    def turn(self, now_s: float) -> None:
        """Start the process when it is time."""
        if self.there and self._child.due(now_s):
            link = self._child.start()
            self._loop.watch(link, self._read)

    def capture(self, session: Session, serial: int) -> None:
        """Have the next picture sent to a program. Raises RequestError where there is no camera."""

        def answer(seen: inside.Seen | None, fd: int | None, why: str) -> None:
            if seen is None or fd is None:
                session.send(Error(Code.CAMERA, 0, f"there is no picture: {why}"), serial)
            else:
                session.send(protocol.Picture(*seen), serial, fd)

        self.look(answer)

    def look(self, taken: Taken) -> None:
        """Call `taken` with the next picture. Raises RequestError where there is no camera."""
        if not self.there:
            raise RequestError(Code.CAMERA, "the headset has no camera: add [camera] to its configuration")
        if self._child.link is None:
            raise RequestError(Code.CAMERA, "the camera's process is being started again: ask again")
        number = next(self._serials)
        try:
            self._child.link.send(inside.Take(), number)
        except OSError as error:
            raise RequestError(Code.CAMERA, f"the camera's process does not read ({error})") from None
        self._asked[number] = taken

    def close(self) -> None:
        """End the process."""
        self._child.stop()

    def _read(self) -> None:
        assert self._child.link is not None
        try:
            serial, message, fd = self._child.link.receive()
        except BlockingIOError:
            return
        except (OSError, ProtocolError) as error:
            self._loop.forget(self._child.link)
            self._child.stop()
            self._metrics.restarts.labels("camera").inc()
            self._missing(f"its process died ({error}) and is started again")
            return
        match message:
            case inside.Missing(text):
                self._missing(text)
            case inside.Seen(exposure_us=exposure_us):
                self.fresh_until_ns = time.monotonic_ns() + self._stale_ns + exposure_us * 1000
                taken = self._asked.pop(serial, None)
                if taken is not None:
                    taken(message, fd, "it came without one")
        if fd is not None:
            os.close(fd)

    def _missing(self, why: str) -> None:
        self.fresh_until_ns = 0
        self._faults.note("camera", why)
        asked, self._asked = self._asked, {}
        for taken in asked.values():
            taken(None, None, why)
