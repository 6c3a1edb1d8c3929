"""A camera of the Luxonis OAK line, through depthai 3 in a process of its own.

camera = open_oak("10.0.0.5")
camera.exposure_ms = 2.0
counts = camera.capture()

After any failure of the camera or of that process (a lost link, missing frames, a hang, a crash), the process is
ended and a new one looks for the camera. The caller gets a capture that takes longer, or a DeviceError with the
reason.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.camera.pixel_unpacking import BIT_DEPTHS, unpack
from firmware_iface.camera.process_keeper import ProcessKeeper
from firmware_iface.errors import DeviceError, DeviceGoneError, InputError


class OakCamera:
    """The camera. Frames run all the time; a capture waits for one that was exposed as requested, after the request.

    See `open_oak`.

    Attributes
    ----------
    shape : (int, int)
        (h, w), pixels.
    bit_depth : int
    """

    def __init__(self, job: dict[str, Any], timeout_s: float, silence_s: float, start_s: float) -> None:
        self.bit_depth = BIT_DEPTHS[job["encoding"]]
        self._job = job
        self._timeout_s = timeout_s
        self._keeper = ProcessKeeper(job, silence_s, start_s)
        with self._keeper.changed:
            self._keeper.changed.wait_for(lambda: self._keeper.frame is not None, start_s)
            first, reason = self._keeper.frame, self._keeper.reason()
        if first is None:
            self.close()
            raise DeviceGoneError(
                f"the camera {job['address'] or ''} sent no picture within {start_s:g} s ({reason}); "
                "check its cable, power and address."
            )
        self.shape: tuple[int, int] = first.height, first.width

    @property
    def restarts(self) -> int:
        """How many processes were lost."""
        return self._keeper.restarts

    @property
    def pid(self) -> int | None:
        """The process that owns the camera now."""
        return self._keeper.pid

    @property
    def exposure_ms(self) -> float:
        """Exposure time, ms.

        Raises
        ------
        InputError
            On setting, unless from 0.001 ms to one frame's time.
        """
        return self._keeper.exposure_us / 1000

    @exposure_ms.setter
    def exposure_ms(self, value: float) -> None:
        self._keeper.set_exposure(checked_exposure_us(value, self._job["frames_per_s"]), self._keeper.iso)

    @property
    def longest_exposure_ms(self) -> float:
        """One frame's time, ms."""
        return 1000 / float(self._job["frames_per_s"])

    @property
    def gain(self) -> float:
        """Gain, 1 at the sensor's base sensitivity.

        Raises
        ------
        InputError
            On setting, unless from 1 to 16.
        """
        return self._keeper.iso / 100

    @gain.setter
    def gain(self, value: float) -> None:
        self._keeper.set_exposure(self._keeper.exposure_us, checked_iso(value))

    def capture(self) -> NDArray[np.uint16]:
        """One picture, exposed with the settings in force and begun after this call.

        Returns
        -------
        uint16 array [h, w], counts

        Raises
        ------
        DeviceError
            Where none comes in time.
        """
        keeper = self._keeper
        requested_ns = time.monotonic_ns()
        exposure_us, iso = keeper.exposure_us, keeper.iso

        def fits() -> bool:
            f = keeper.frame
            return (
                f is not None
                and f.begin_ns >= requested_ns
                and f.iso == iso
                and abs(f.exposure_us - exposure_us) <= max(20, 0.02 * exposure_us)  # sensors count lines
            )

        with keeper.changed:
            keeper.changed.wait_for(lambda: fits() or keeper.closing, self._timeout_s + exposure_us * 3e-6)
            frame = keeper.frame
            if keeper.closing or not fits() or frame is None:
                raise DeviceError(
                    f"the camera gave no picture within {self._timeout_s:g} s ({keeper.reason()}); "
                    "it is being looked for, try again."
                )
        try:
            counts = unpack(frame.data, self._job["encoding"], frame.height, frame.width, frame.stride)
        except ValueError as error:
            raise DeviceError(f"the camera sent a broken picture: {error}; try again.") from error
        if counts.shape != self.shape:
            raise DeviceError(
                f"the camera came back with pictures of {counts.shape} instead of {self.shape}; open it again."
            )
        return counts

    def status(self) -> dict[str, Any]:
        """What the camera's process reports, and its losses so far."""
        return self._keeper.status() | {
            "exposure_ms": self.exposure_ms,
            "gain": self.gain,
            "pid": self.pid,
        }

    def close(self) -> None:
        """End the camera's process."""
        self._keeper.close()


def checked_exposure_us(exposure_ms: float, frames_per_s: float) -> int:
    """Exposure in µs.

    Raises
    ------
    InputError
        Unless it is from 0.001 ms to one frame's time.
    """
    longest = 1000 / frames_per_s
    if not (isinstance(exposure_ms, int | float | np.floating) and 0.001 <= exposure_ms <= longest):
        raise InputError(
            f"exposure {exposure_ms!r} ms is out of range; give 0.001 to {longest:.4g} ms, "
            "or open the camera with fewer frames a second."
        )
    return round(float(exposure_ms) * 1000)


def checked_iso(gain: float) -> int:
    """Sensitivity.

    Raises
    ------
    InputError
        Unless the gain is from 1 to 16.
    """
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

    Parameters
    ----------
    address : str
        IP address, MX ID or USB path; empty: the first that is found.
    encoding : str
        "raw10" (the sensor's own 10 bits, its own size) or "gray8" (`shape`, 8 bits).
    shape : (int, int), pixels
        (h, w) for "gray8".
    frames_per_s : float
    exposure_ms : float, ms
        0.001 to one frame's time.
    gain : float
        1 to 16.
    timeout_s : float, s
        Longest wait for a picture, restarts of the process included.
    starved_s : float, s
        After so long without frames, the link is taken as lost.
    start_s : float, s
        Longest wait for the first picture.

    Returns
    -------
    OakCamera

    Raises
    ------
    InputError
        For settings out of range.
    DeviceError
        Where depthai is not installed.
    DeviceGoneError
        Where no picture comes.
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
