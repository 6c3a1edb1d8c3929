"""The process that owns the camera: `python -m runtime.service.camera_process FD CONFIGURATION`.

The camera's library can take its process down, and can stop delivering without saying so. So it lives here:
pictures are taken one after the other and each is a sign of life; a picture that does not come in time ends
this process, and the supervisor starts it again; a camera that is not there is looked for again and again.
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
from runtime.service.children import child_link
from runtime.service.configuration import read_configuration
from runtime.service.inside import CAMERA, Missing, Seen, Take
from runtime.service.link import Link
from runtime.service.ring import sealed_copy

STARVED_S = 2.0  # beyond the exposure: a library that has delivered nothing for so long has hung
OPENING_S = 20.0  # a camera on a network takes seconds
AGAIN_S = 0.2
SHORTEST_S = 0.010  # from one picture to the next, so that a fast camera does not take a core


class Watchdog(threading.Thread):
    """Ends the process when `fed` was not called for `limit_s`: what hangs inside a library cannot be asked to stop."""

    def __init__(self, limit_s: float) -> None:
        super().__init__(daemon=True)
        self.limit_s = limit_s
        self._last = time.monotonic()

    def fed(self) -> None:
        """The camera delivers, or is known not to be there."""
        self._last = time.monotonic()

    def run(self) -> None:
        while time.monotonic() - self._last < self.limit_s:
            time.sleep(0.05)
        os._exit(3)


def main(fd: str, configuration: str) -> None:
    """Take pictures until the supervisor closes the link."""
    link = child_link(fd, CAMERA)
    table = read_configuration(configuration).devices["camera"]
    wanted: queue.SimpleQueue[int] = queue.SimpleQueue()
    threading.Thread(target=_requests, args=(link, wanted), daemon=True).start()
    watchdog = Watchdog(OPENING_S)
    watchdog.start()
    while True:
        try:
            camera = open_camera(table)
        except (DeviceError, InputError, OSError) as error:
            link.send(Missing(str(error)))
        else:
            watchdog.fed()
            watchdog.limit_s = STARVED_S + camera.exposure_ms * 1e-3
            with closing(camera):
                _pictures(link, camera, wanted, watchdog)
        watchdog.fed()
        watchdog.limit_s = OPENING_S
        time.sleep(AGAIN_S)


def _pictures(link: Link, camera: Any, wanted: queue.SimpleQueue[int], watchdog: Watchdog) -> None:
    """Take pictures until the camera has gone."""
    while True:
        try:
            _picture(link, camera, wanted)
        except DeviceError as error:
            link.send(Missing(str(error)))
            if isinstance(error, DeviceGoneError):
                return
        watchdog.fed()


def _requests(link: Link, wanted: queue.SimpleQueue[int]) -> None:
    """Note who asks for a picture; the end of the link is the end of the process."""
    while True:
        try:
            serial, message, _ = link.receive()
        except OSError:
            os._exit(0)
        if isinstance(message, Take):
            wanted.put(serial)


def _picture(link: Link, camera: Any, wanted: queue.SimpleQueue[int]) -> None:
    """Take one picture; it goes to all who had asked for it before it began."""
    began = time.monotonic()
    asked = [wanted.get_nowait() for _ in range(wanted.qsize())]
    counts: np.ndarray = camera.capture()
    height, width = counts.shape
    exposure_us = min(int(camera.exposure_ms * 1000), 2**32 - 1)
    seen = Seen(time.monotonic_ns(), height, width, camera.bit_depth, exposure_us)
    for serial in asked or [0]:
        if serial:
            picture = sealed_copy(np.ascontiguousarray(counts, np.uint16))
            link.send(seen, serial, [picture])
            os.close(picture)
        else:
            link.send(seen)
    time.sleep(max(0.0, began + SHORTEST_S - time.monotonic()))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except ConnectionError:
        os._exit(0)
