"""The process that owns the camera: `python -m runtime.service.camera_process FD CONFIGURATION`.

The camera's library can end its process, and can stop delivering without an error. So it has a process of its own.
Pictures are taken one after the other and each is a sign of life. A picture that does not come in time ends this
process, and the supervisor starts it again. A camera that is missing is opened again and again until it answers.
"""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from contextlib import closing
from typing import Any

import numpy as np

from firmware_iface.configured_devices import open_camera
from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from runtime.service.child_processes import child_link
from runtime.service.configuration import read_configuration
from runtime.service.process_messages import CAMERA, CameraMissing, CameraPicture, TakePicture
from runtime.service.shared_memory import sealed_copy
from runtime.service.socket_link import MessageLink

STARVED_S = 2.0  # beyond the exposure: a library that delivered nothing for so long hangs
OPENING_S = 20.0  # a camera on a network takes seconds
AGAIN_S = 0.2
SHORTEST_S = 0.010  # from one picture to the next, so that a fast camera does not take a core


class Watchdog(threading.Thread):
    """Ends the process when `feed` was not called for `limit_s`: a library that hangs cannot be stopped otherwise."""

    def __init__(self, limit_s: float) -> None:
        super().__init__(daemon=True)
        self.limit_s = limit_s
        self._last = time.monotonic()

    def feed(self) -> None:
        """The camera delivers, or is known to be missing."""
        self._last = time.monotonic()

    def run(self) -> None:
        while time.monotonic() - self._last < self.limit_s:
            time.sleep(0.05)
        os._exit(3)


def main(fd: str, configuration: str) -> None:
    """Take pictures until the supervisor closes the link."""
    link = child_link(fd, CAMERA)
    table = read_configuration(configuration).devices["camera"]
    requests: queue.SimpleQueue[int] = queue.SimpleQueue()
    threading.Thread(target=_read_requests, args=(link, requests), daemon=True).start()
    watchdog = Watchdog(OPENING_S)
    watchdog.start()
    while True:
        try:
            camera = open_camera(table)
        except (DeviceError, InputError, OSError) as error:
            link.send(CameraMissing(str(error)))
        else:
            watchdog.feed()
            watchdog.limit_s = STARVED_S + camera.exposure_ms * 1e-3
            with closing(camera):
                _take_pictures(link, camera, requests, watchdog)
        watchdog.feed()
        watchdog.limit_s = OPENING_S
        time.sleep(AGAIN_S)


def _take_pictures(
    link: MessageLink, camera: Any, requests: queue.SimpleQueue[int], watchdog: Watchdog
) -> None:
    """Take pictures until the camera is disconnected."""
    while True:
        try:
            _take_picture(link, camera, requests)
        except DeviceError as error:
            link.send(CameraMissing(str(error)))
            if isinstance(error, DeviceGoneError):
                return
        watchdog.feed()


def _read_requests(link: MessageLink, requests: queue.SimpleQueue[int]) -> None:
    """Note the requests for pictures; the process ends with the link."""
    while True:
        try:
            serial, message, _ = link.receive()
        except OSError:
            os._exit(0)
        if isinstance(message, TakePicture):
            requests.put(serial)


def _take_picture(link: MessageLink, camera: Any, requests: queue.SimpleQueue[int]) -> None:
    """Take one picture; it answers all requests that came before its exposure."""
    began = time.monotonic()
    serials = [requests.get_nowait() for _ in range(requests.qsize())]
    counts: np.ndarray = camera.capture()
    height, width = counts.shape
    exposure_us = min(int(camera.exposure_ms * 1000), 2**32 - 1)
    record = CameraPicture(time.monotonic_ns(), height, width, camera.bit_depth, exposure_us)
    for serial in serials or [0]:
        if serial:
            picture = sealed_copy(np.ascontiguousarray(counts, np.uint16))
            link.send(record, serial, [picture])
            os.close(picture)
        else:
            link.send(record)
    time.sleep(max(0.0, began + SHORTEST_S - time.monotonic()))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except ConnectionError:
        os._exit(0)
