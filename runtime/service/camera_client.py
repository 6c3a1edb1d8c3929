"""The supervisor's side of the camera's process: its signs of life, and pictures for programs and refinements."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from itertools import count

from runtime.service import protocol
from runtime.service.child_processes import ChildProcess
from runtime.service.configuration import Configuration
from runtime.service.event_loop import EventLoop
from runtime.service.fault_log import FaultLog
from runtime.service.message_format import ProtocolError
from runtime.service.metrics import Metrics
from runtime.service.process_messages import CAMERA, CameraMissing, CameraPicture, TakePicture
from runtime.service.program_session import RequestError, Session
from runtime.service.protocol import Code, Error

# Called with a picture and the descriptor of its memfd, or with None, None and the reason.
PictureReceiver = Callable[[CameraPicture | None, int | None, str], None]


class CameraClient:
    """The camera's process, where the configuration has a camera.

    Attributes
    ----------
    configured : bool
        Whether the configuration has a camera.
    fresh_until_ns : int, ns
        Until when the camera counts as fresh (CLOCK_MONOTONIC); 0: it does not deliver.
    """

    def __init__(
        self, configuration: Configuration, loop: EventLoop, faults: FaultLog, metrics: Metrics
    ) -> None:
        self.configured = "camera" in configuration.devices
        self.fresh_until_ns = 0
        self._process = ChildProcess("runtime.service.camera_process", str(configuration.file), CAMERA)
        self._stale_ns = int(configuration.timing.stale_limit_ms * 1e6)
        self._loop, self._faults, self._metrics = loop, faults, metrics
        self._receivers: dict[int, PictureReceiver] = {}  # by serial
        self._serials = count(1)
        self._out = False  # it has delivered nothing since it was reported missing

    def turn(self, now_s: float) -> None:
        """Start the process when it is time."""
        if self.configured and self._process.due(now_s):
            link = self._process.start()
            self._loop.watch(link, self._read)

    def send_picture(self, session: Session, serial: int) -> None:
        """Send the next picture to a program, as the answer to its request.

        Raises
        ------
        RequestError
            Where no picture can be taken.
        """

        def answer(picture: CameraPicture | None, fd: int | None, why: str) -> None:
            if picture is None or fd is None:
                session.send(Error(Code.CAMERA, 0, f"there is no picture: {why}"), serial)
            else:
                session.send(protocol.Picture(*picture), serial, fd)

        self.take_picture(answer)

    def take_picture(self, receiver: PictureReceiver) -> None:
        """Call `receiver` with the next picture.

        Raises
        ------
        RequestError
            Where no picture can be taken.
        """
        if not self.configured:
            raise RequestError(Code.CAMERA, "the headset has no camera: add [camera] to its configuration")
        if self._process.link is None:
            raise RequestError(Code.CAMERA, "the camera's process is being started again: ask again")
        number = next(self._serials)
        try:
            self._process.link.send(TakePicture(), number)
        except OSError as error:
            raise RequestError(Code.CAMERA, f"the camera's process does not read ({error})") from None
        self._receivers[number] = receiver

    def close(self) -> None:
        """End the process."""
        self._process.stop()

    def _read(self) -> None:
        assert self._process.link is not None
        try:
            serial, message, fd = self._process.link.receive()
        except BlockingIOError:
            return
        except (OSError, ProtocolError) as error:
            self._loop.forget(self._process.link)
            self._process.stop()
            self._metrics.restarts.labels("camera").inc()
            self._missing(f"its process died ({error}) and is started again")
            return
        match message:
            case CameraMissing(text):
                self._missing(text)
            case CameraPicture(exposure_us=exposure_us):
                self._out = False
                self.fresh_until_ns = time.monotonic_ns() + self._stale_ns + exposure_us * 1000
                receiver = self._receivers.pop(serial, None)
                if receiver is not None:
                    receiver(message, fd, "it came without one")
        if fd is not None:
            os.close(fd)

    def _missing(self, why: str) -> None:
        self.fresh_until_ns = 0
        self._faults.note("camera", why, ongoing=self._out)
        self._out = True
        receivers, self._receivers = self._receivers, {}
        for receiver in receivers.values():
            receiver(None, None, why)
