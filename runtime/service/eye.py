"""The supervisor's side of the camera's process: its signs of life, and pictures for programs."""

from __future__ import annotations

import os
import time
from itertools import count

from runtime.service import inside, protocol
from runtime.service.children import Child
from runtime.service.configuration import Configuration
from runtime.service.faults import Faults
from runtime.service.loop import Loop
from runtime.service.messages import ProtocolError
from runtime.service.metrics import Metrics
from runtime.service.protocol import Code, Error
from runtime.service.sessions import RequestError, Session


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
        self._asked: dict[int, tuple[Session, int]] = {}
        self._serials = count(1)

    def turn(self, now_s: float) -> None:
        """Start the process when it is time."""
        if self.there and self._child.due(now_s):
            link = self._child.start()
            self._loop.watch(link, self._read)

    def capture(self, session: Session, serial: int) -> None:
        """Have the next picture sent to a program. Raises RequestError where there is no camera."""
        if not self.there:
            raise RequestError(Code.CAMERA, "the headset has no camera: add [camera] to its configuration")
        if self._child.link is None:
            raise RequestError(Code.CAMERA, "the camera's process is being started again: ask again")
        number = next(self._serials)
        try:
            self._child.link.send(inside.Take(), number)
        except OSError as error:
            raise RequestError(Code.CAMERA, f"the camera's process does not read ({error})") from None
        self._asked[number] = (session, serial)

    def forget(self, session: Session) -> None:
        """A program has gone."""
        self._asked = {n: asked for n, asked in self._asked.items() if asked[0] is not session}

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
                session, asked = self._asked.pop(serial, (None, 0))
                if session is not None and fd is not None:
                    session.send(protocol.Picture(*message), asked, fd)
        if fd is not None:
            os.close(fd)

    def _missing(self, why: str) -> None:
        self.fresh_until_ns = 0
        self._faults.note("camera", why)
        asked, self._asked = self._asked, {}
        for session, serial in asked.values():
            session.send(Error(Code.CAMERA, 0, f"there is no picture: {why}"), serial)
