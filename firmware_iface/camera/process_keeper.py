"""Keeps a camera process running, restarts it when it is lost, and holds the newest frame that it sent."""

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

from firmware_iface.camera.depthai_process import FAILED, LOST, STARVED
from firmware_iface.camera.process_messages import Frame, Messages

_REASONS = {LOST: "the link was lost", STARVED: "frames stayed out", FAILED: "the library refused"}


class ProcessKeeper:
    """One camera process at a time, and a thread that reads from it.

    Parameters
    ----------
    job : dict
        What the process is started with; see `open_oak`.
    silence_s : float, s
        A process that streams and sends nothing for so long is taken to hang.
    start_s : float, s
        The same for a process that starts.

    Attributes
    ----------
    changed : threading.Condition
        Notified with each frame and on closing; guards the attributes below.
    frame : Frame or None
        The newest frame.
    exposure_us, iso : int
        Settings in force.
    restarts : int
        How many processes were lost.
    closing : bool
    """

    def __init__(self, job: dict[str, Any], silence_s: float, start_s: float) -> None:
        self.changed = threading.Condition()
        self.frame: Frame | None = None
        self.frames = 0
        self.restarts = 0
        self.closing = False
        self.exposure_us: int = job["exposure_us"]
        self.iso: int = job["iso"]
        self._job = job
        self._silence_s, self._start_s = silence_s, start_s
        self._state = "starting"
        self._loss = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._orders = -1
        self._thread = threading.Thread(target=self._keep, name="camera keeper", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """The process that owns the camera now."""
        process = self._process
        return process.pid if process else None

    def reason(self) -> str:
        """The last loss and the present state, for messages."""
        return ", ".join(text for text in (self._loss, self._state) if text)

    def status(self) -> dict[str, Any]:
        """State, losses and frames, ready for JSON."""
        with self.changed:
            frame = self.frame
            age_ms = None if frame is None else (time.monotonic_ns() - frame.end_ns) / 1e6
            return {
                "state": self._state,
                "last_loss": self._loss,
                "restarts": self.restarts,
                "frames": self.frames,
                "frame_age_ms": age_ms,
            }

    def set_exposure(self, exposure_us: int, iso: int) -> None:
        """Use these settings from now on, also in a process that is started later."""
        self.exposure_us, self.iso = exposure_us, iso
        self._send_settings()

    def close(self) -> None:
        """End the process."""
        with self.changed:
            self.closing = True
            self.changed.notify_all()
        self._thread.join(self._silence_s + 2)

    def _send_settings(self) -> None:
        with self.changed, suppress(OSError):
            os.write(self._orders, f"[{self.exposure_us}, {self.iso}]\n".encode())

    def _keep(self) -> None:
        """Keep a process running until closed."""
        while not self.closing:
            begun = time.monotonic()
            try:
                loss = self._run_one()
            except OSError as error:
                loss = f"its process could not be started: {error}"
            with self.changed:
                if self.closing:
                    return
                self.restarts += 1
                self._loss, self._state = loss, "starting"
                self.changed.wait_for(lambda: self.closing, max(0, 0.5 - (time.monotonic() - begun)))

    def _run_one(self) -> str:
        """Start a process, take what it sends until it ends or is silent, and say why it ended."""
        incoming, child_out = os.pipe()
        child_in, orders = os.pipe()
        job = self._job | {
            "exposure_us": self.exposure_us,
            "iso": self.iso,
            "in": child_in,
            "out": child_out,
            "parent": os.getpid(),
        }
        command = [sys.executable, "-m", f"{__package__}.depthai_process", json.dumps(job)]
        process = subprocess.Popen(
            command,
            pass_fds=(child_in, child_out),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(child_in)
        os.close(child_out)
        with self.changed:
            self._process, self._orders = process, orders
        self._send_settings()
        try:
            return self._receive(incoming) or _ended(process.wait(self._silence_s))
        except subprocess.TimeoutExpired:
            return "its process did not end"
        finally:
            with self.changed:
                self._process, self._orders = None, -1
            os.close(orders)  # asks the process to end by itself
            if self.closing:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(0.5)
            process.kill()
            process.wait()
            os.close(incoming)

    def _receive(self, incoming: int) -> str:
        """Take messages; says why it stopped, or "" at the end of the stream."""
        messages = Messages()
        received_at = time.monotonic()
        while not self.closing:
            if not select.select([incoming], [], [], 0.05)[0]:
                limit_s = self._silence_s if self._state == "streaming" else self._start_s
                if time.monotonic() - received_at > limit_s + 2e-6 * self.exposure_us:
                    return "its process hung"
                continue
            data = os.read(incoming, 1 << 20)
            received_at = time.monotonic()
            if not data:
                return ""
            try:
                for message in messages.feed(data):
                    self._take(message)
            except ValueError as error:
                return str(error)
        return "closed"

    def _take(self, message: str | Frame) -> None:
        with self.changed:
            if isinstance(message, Frame):
                self.frame, self._state = message, "streaming"
                self.frames += 1
                self.changed.notify_all()
            else:
                self._state = message


def _ended(code: int) -> str:
    if code < 0:
        return f"its process was ended by signal {-code}"
    return _REASONS.get(code, f"its process ended with code {code}")
