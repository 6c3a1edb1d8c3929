"""The solver's side of a refinement: its process, the pattern that it wants displayed, and captures for it."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from firmware_iface.lasers.eye_safety import SIZES_MRAD
from runtime.service.child_processes import ChildProcess, in_background
from runtime.service.configuration import Configuration
from runtime.service.frame_solver import Pattern
from runtime.service.message_format import ProtocolError
from runtime.service.process_messages import (
    REFINEMENT,
    RefinedPattern,
    RefinementCapture,
    RefinementEnd,
    RefinementTarget,
    RefinePicture,
    StopRefinement,
)
from runtime.service.shared_memory import read_sealed, sealed_copy


class RefinementClient(threading.Thread):
    """A picture's refinement. The thread waits for what its process sends; it is started by the one who made it.

    Parameters
    ----------
    configuration : Configuration
    target : float32 array [1, H, W]
        Irradiance.
    crc : int
        CRC-32 of the picture's bytes in its slot.
    request : RefinePicture
        Number of captures at most, and counts without light.
    ended : callable
        Called with the result, in this thread.

    Attributes
    ----------
    crc : int
    pattern : Pattern or None
        The pattern to display now, and after the end the best; None until the first is made.
    """

    def __init__(
        self,
        configuration: Configuration,
        target: np.ndarray,
        crc: int,
        request: RefinePicture,
        ended: Callable[[RefinementEnd], None],
    ) -> None:
        super().__init__(name="refinement", daemon=True)
        self.crc = crc
        self.pattern: Pattern | None = None
        self._number, self._ended = request.number, ended
        self._awaited: int | None = None  # CRC-32 of the pattern whose capture is needed
        # Started here, in the thread that lives as long as this process: a child ends with the thread that started it.
        self._process = ChildProcess(
            "runtime.service.refinement_process", str(configuration.file), REFINEMENT, in_background
        )
        self._link = self._process.start()
        self._link.connection.setblocking(True)
        fd = sealed_copy(target)
        try:
            height, width = target.shape[1:]
            task = RefinementTarget(request.number, request.captures, request.black, height, width)
            with suppress(OSError):  # it has ended already; the thread finds out
                self._link.send(task, fds=[fd])
        finally:
            os.close(fd)

    def take(self, capture: RefinementCapture, fd: int) -> None:
        """Pass on a capture of the display, if it is the one that is needed; the caller closes `fd`."""
        if capture.crc == self._awaited:
            self._awaited = None
            with suppress(OSError):
                self._link.send(capture, fds=[fd])

    def stop(self) -> None:
        """End it: its picture is no longer displayed."""
        with suppress(OSError):
            self._link.send(StopRefinement())

    def run(self) -> None:
        end: RefinementEnd | None = None
        try:
            while end is None:
                _, message, fd = self._link.receive()
                match message:
                    case RefinedPattern(crc, height, width, psnr_db, shares) if fd is not None:
                        gray = read_sealed(fd, (1, height, width), np.uint8)
                        spots = struct.unpack_from(f"<{len(SIZES_MRAD)}f", shares)
                        predicted = spots if any(spots) else ()
                        self.pattern = Pattern(gray, psnr_db, final=True, shares=predicted)
                        self._awaited = crc
                    case RefinementEnd():
                        end = message
        except (OSError, ProtocolError) as error:
            end = RefinementEnd(self._number, 0, 0.0, 0.0, f"its process ended ({error})")
        self._process.stop()
        with suppress(OSError):  # the supervisor has ended, and this process ends too
            self._ended(end)
