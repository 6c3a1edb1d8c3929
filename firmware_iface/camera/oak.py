"""A camera on the Luxonis OAK line, through depthai 3 in a process of its own.

camera = open_oak("10.0.0.5")
camera.exposure_ms = 2.0
counts = camera.capture()

Whatever happens to the camera or to that process (a lost link, frames that stay out, a hang, a crash), there
is one way back: the process is ended, and a new one looks for the camera. The caller sees a capture that
takes longer, or a DeviceError that says why there is none.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.camera.depthai_process import FAILED, LOST, STARVED
from firmware_iface.camera.pixel_unpacking import BIT_DEPTHS, unpack
from firmware_iface.camera.process_messages import Frame, Messages
from firmware_iface.errors import DeviceError, DeviceGoneError, InputError

_WHY = {LOST: "the link was lost", STARVED: "frames stayed out", FAILED: "the library refused"}


class OakCamera:
    """The camera. Frames run all the time; a capture waits for one that was exposed as asked, after it asked.

    See `open_oak`. Attributes: shape ((h, w), pixels), bit_depth, restarts (how many processes were lost).
    """

    def __init__(self, job: dict[str, Any], timeout_s: float, silence_s: float, start_s: float) -> None:
        self.bit_depth = BIT_DEPTHS[job["encoding"]]
        self.restarts = 0
        self._job = job
        self._timeout_s, self._silence_s, self._start_s = timeout_s, silence_s, start_s
        self._exposure_us, self._iso = job["exposure_us"], job["iso"]
        self._news = threading.Condition()
        self._frame: Frame | None = None
        self._frames = 0
        self._state = "starting"
        self._loss = ""
        self._closing = False
        self._process: subprocess.Popen[bytes] | None = None
        self._orders = -1
        self._keeper = threading.Thread(target=self._keep, name="camera keeper", daemon=True)
        self._keeper.start()
        with self._news:
            self._news.wait_for(lambda: self._frame is not None, start_s)
            first, reason = self._frame, self._reason()
        if first is None:
            self.close()
            raise DeviceGoneError(
                f"the camera {job['address'] or ''} sent no picture within {start_s:g} s ({reason}); "
                "check its cable, power and address."
            )
        self.shape: tuple[int, int] = first.height, first.width

    @property
    def pid(self) -> int | None:
        """The process that owns the camera now."""
        process = self._process
        return process.pid if process else None

    @property
    def exposure_ms(self) -> float:
        """Exposure time, ms; setting it raises InputError unless from 0.001 ms to one frame's time."""
        return self._exposure_us / 1000

    @exposure_ms.setter
    def exposure_ms(self, value: float) -> None:
        self._exposure_us = checked_exposure_us(value, self._job["frames_per_s"])
        self._order()

    @property
    def longest_exposure_ms(self) -> float:
        """One frame's time, ms."""
        return 1000 / float(self._job["frames_per_s"])

    @property
    def gain(self) -> float:
        """Gain, 1 at the sensor's base sensitivity; setting it raises InputError unless from 1 to 16."""
        return self._iso / 100

    @gain.setter
    def gain(self, value: float) -> None:
        self._iso = checked_iso(value)
        self._order()

    def capture(self) -> NDArray[np.uint16]:
        """One picture, uint16 counts [h, w], exposed with the settings in force and begun after this call.

        Raises DeviceError where none comes in time.
        """
        asked_ns = time.monotonic_ns()
        wanted = self._exposure_us, self._iso

        def fits() -> bool:
            f = self._frame
            return (
                f is not None
                and f.begin_ns >= asked_ns
                and f.iso == wanted[1]
                and abs(f.exposure_us - wanted[0]) <= max(20, 0.02 * wanted[0])  # sensors count lines
            )

        with self._news:
            self._news.wait_for(lambda: fits() or self._closing, self._timeout_s + wanted[0] * 3e-6)
            frame = self._frame
            if self._closing or not fits() or frame is None:
                raise DeviceError(
                    f"the camera gave no picture within {self._timeout_s:g} s ({self._reason()}); "
                    "it is being looked for, try again."
                )
        try:
            counts = unpack(frame.data, self._job["encoding"], frame.height, frame.width, frame.stride)
        except ValueError as error:
            raise DeviceError(f"the camera sent a broken picture: {error}; try again.") from error
        if counts.shape != self.shape:
            raise DeviceError(
                f"the camera came back with pictures of {counts.shape} instead of {self.shape}; open it anew."
            )
        return counts

    def status(self) -> dict[str, Any]:
        """What the camera's process says, and how it has fared."""
        with self._news:
            frame = self._frame
            age = None if frame is None else (time.monotonic_ns() - frame.end_ns) / 1e6
            return {
                "state": self._state,
                "last_loss": self._loss,
                "restarts": self.restarts,
                "frames": self._frames,
                "frame_age_ms": age,
                "exposure_ms": self.exposure_ms,
                "gain": self.gain,
                "pid": self.pid,
            }

    def close(self) -> None:
        """End the camera's process."""
        with self._news:
            self._closing = True
            self._news.notify_all()
        self._keeper.join(self._silence_s + 2)

    def _reason(self) -> str:
        return ", ".join(text for text in (self._loss, self._state) if text)

    def _order(self) -> None:
        with self._news, suppress(OSError):
            os.write(self._orders, f"[{self._exposure_us}, {self._iso}]\n".encode())

    def _keep(self) -> None:
        """Keep a process running until closed."""
        while not self._closing:
            begun = time.monotonic()
            try:
                loss = self._run_one()
            except OSError as error:
                loss = f"its process could not be started: {error}"
            with self._news:
                if self._closing:
                    return
                self.restarts += 1
                self._loss, self._state = loss, "starting"
                self._news.wait_for(lambda: self._closing, max(0, 0.5 - (time.monotonic() - begun)))

    def _run_one(self) -> str:
        """Start a process, take what it sends until it ends or is silent, and say why it ended."""
        incoming, theirs_out = os.pipe()
        theirs_in, orders = os.pipe()
        job = self._job | {
            "exposure_us": self._exposure_us,
            "iso": self._iso,
            "in": theirs_in,
            "out": theirs_out,
            "parent": os.getpid(),
        }
        command = [sys.executable, "-m", f"{__package__}.depthai_process", json.dumps(job)]
        process = subprocess.Popen(
            command,
            pass_fds=(theirs_in, theirs_out),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        with self._news:
            self._process, self._orders = process, orders
        self._order()
        try:
            return self._listen(incoming) or _ended(process.wait(self._silence_s))
        except subprocess.TimeoutExpired:
            return "its process did not end"
        finally:
            with self._news:
                self._process, self._orders = None, -1
            os.close(orders)  # asks the process to end by itself
            if self._closing:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(0.5)
            process.kill()
            process.wait()
            os.close(incoming)

    def _listen(self, incoming: int) -> str:
        """Take messages; says why it stopped, or "" at the end of the stream."""
        messages = Messages()
        heard = time.monotonic()
        while not self._closing:
            if not select.select([incoming], [], [], 0.05)[0]:
                patience = self._silence_s if self._state == "streaming" else self._start_s
                if time.monotonic() - heard > patience + 2e-6 * self._exposure_us:
                    return "its process hung"
                continue
            data = os.read(incoming, 1 << 20)
            heard = time.monotonic()
            if not data:
                return ""
            try:
                for message in messages.feed(data):
                    self._take(message)
            except ValueError as error:
                return str(error)
        return "closed"

    def _take(self, message: str | Frame) -> None:
        with self._news:
            if isinstance(message, Frame):
                self._frame, self._state = message, "streaming"
                self._frames += 1
                self._news.notify_all()
            else:
                self._state = message


def _ended(code: int) -> str:
    if code < 0:
        return f"its process was ended by signal {-code}"
    return _WHY.get(code, f"its process ended with code {code}")


def checked_exposure_us(exposure_ms: float, frames_per_s: float) -> int:
    """Exposure in µs; raises InputError unless it is from 0.001 ms to one frame's time."""
    longest = 1000 / frames_per_s
    if not (isinstance(exposure_ms, int | float | np.floating) and 0.001 <= exposure_ms <= longest):
        raise InputError(
            f"exposure {exposure_ms!r} ms is out of range; give 0.001 to {longest:.4g} ms, "
            "or open the camera with fewer frames a second."
        )
    return round(float(exposure_ms) * 1000)


def checked_iso(gain: float) -> int:
    """Sensitivity; raises InputError unless the gain is from 1 to 16."""
    if not (isinstance(gain, int | float | np.floating) and 1 <= gain <= 16):
        raise InputError(f"gain {gain!r} is out of range; give 1 to 16.")
    return round(float(gain) * 100)


def open_oak(
    address: str = "",
    *,
    encoding: str = "raw10",
    shape: tuple[int, int] = (800, 1280),
    frames_per_s: float = 30.0,
    exposure_ms: float = 10.0,
    gain: float = 1.0,
    timeout_s: float = 5.0,
    starved_s: float = 1.0,
    start_s: float = 15.0,
) -> OakCamera:
    """Open a camera and wait for its first picture.

    address : its IP address, MX ID or USB path; empty: the first that is found
    encoding : "raw10" (the sensor's own 10 bits, its own size) or "gray8" (`shape`, 8 bits)
    timeout_s : longest wait for a picture, restarts of the process included
    starved_s : without frames for so long, the link is taken for dead
    start_s : longest wait for the first picture
    Raises InputError for settings out of range, DeviceGoneError where no picture comes.
    """
    import importlib.util

    if importlib.util.find_spec("depthai") is None:
        raise DeviceError("depthai is not installed; install hololoop with the extra 'camera'.")
    if encoding not in BIT_DEPTHS:
        raise InputError(f"encoding '{encoding}' is not known; use one of {', '.join(BIT_DEPTHS)}.")
    job = {
        "address": address,
        "encoding": encoding,
        "shape": shape,
        "frames_per_s": frames_per_s,
        "starved_s": starved_s,
        "exposure_us": checked_exposure_us(exposure_ms, frames_per_s),
        "iso": checked_iso(gain),
    }
    return OakCamera(job, timeout_s, silence_s=starved_s + 2, start_s=start_s)
