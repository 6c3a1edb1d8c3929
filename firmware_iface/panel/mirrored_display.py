"""Frames over a display link: a panel that is a second screen, through Linux's frame buffer and no library.

Two screens' worth of memory are used in turn and the display is panned to the one that is complete, so no
torn frame is scanned out. The console must not draw there (`con2fbmap`, or `fbcon=map:` at boot).
"""

from __future__ import annotations

import mmap
import time
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.panel.panel import Gray, Panel


class MirroredDisplay:
    """A frame buffer whose screen the panel mirrors, gray levels in all colours.

    Parameters
    ----------
    number : int
        N of /dev/fbN.
    shape : (int, int)
        (H, W), the panel's pixels, drawn at the screen's top left.
    settle_s : float, s
        From the start of a frame on the link until the panel has followed.
    devices, settings : Path
        Folders where the kernel shows frame buffers.

    Raises
    ------
    InputError
        Where the screen cannot carry the panel.
    DeviceError, DeviceGoneError
        Where it cannot be opened.
    """

    def __init__(
        self,
        number: int,
        shape: tuple[int, int],
        settle_s: float = 0.05,
        devices: Path = Path("/dev"),
        settings: Path = Path("/sys/class/graphics"),
    ) -> None:
        self.shape = shape
        self.name = f"the display fb{number}"
        self._settings = settings / f"fb{number}"
        self._settle_s = settle_s
        self._sent = 0
        self._shown_s = 0.0
        self._read_settings()
        path = devices / f"fb{number}"
        try:
            with path.open("r+b") as file:
                self._mapped = mmap.mmap(file.fileno(), 2 * self._rows * self._stride)
        except PermissionError as error:
            raise DeviceError(f"this user may not open {path}; add it to the group video.") from error
        except (OSError, ValueError) as error:
            raise DeviceGoneError(
                f"{path} cannot be mapped ({error}); check the display's driver."
            ) from error

    def send(self, gray: Gray) -> int:
        """Draw into the half that is not shown, then pan to it."""
        height, width = self.shape
        half = (self._sent + 1) % 2
        memory = np.frombuffer(self._mapped, np.uint8).reshape(2 * self._rows, self._stride)
        screen = memory[half * self._rows : half * self._rows + height, : width * self._bytes]
        screen.reshape(height, width, self._bytes)[:, :, :3] = gray[..., None]
        self._set("pan", f"0,{half * self._rows}")
        self._sent += 1
        self._shown_s = time.monotonic() + self._settle_s
        return self._sent

    def wait(self, sequence: int) -> None:
        if sequence != self._sent:
            raise DeviceError(f"{self.name} shows frame {self._sent}, not {sequence}; show it again.")
        time.sleep(max(0.0, self._shown_s - time.monotonic()))

    def status(self) -> dict[str, Any]:
        """Mode of the screen.

        Raises
        ------
        DeviceGoneError
            Where the screen is disconnected.
        """
        return {"mode": self._get("mode"), "pan": self._get("pan"), "bits_per_pixel": 8 * self._bytes}

    def close(self) -> None:
        """Leave the display at gray 0."""
        if not self._mapped.closed:
            self._mapped[:] = bytes(len(self._mapped))
            self._mapped.close()

    def _read_settings(self) -> None:
        columns, rows = (int(n) for n in self._get("virtual_size").split(","))
        self._bytes = int(self._get("bits_per_pixel")) // 8
        self._stride = int(self._get("stride"))
        self._rows = rows // 2
        height, width = self.shape
        if self._bytes not in (1, 3, 4):
            raise InputError(
                f"{self.name} has {8 * self._bytes} bits a pixel, too few for 256 gray levels; "
                "set it to 24 or 32 (fbset -depth 32)."
            )
        if height > self._rows or width > columns:
            raise InputError(
                f"{self.name} holds two screens of {self._rows} rows and {columns} columns, less than the "
                f"panel's {height} x {width}; make it larger (fbset -vyres {2 * height})."
            )

    def _get(self, name: str) -> str:
        try:
            return (self._settings / name).read_text(encoding="ascii").strip()
        except OSError as error:
            raise DeviceGoneError(
                f"{self.name} is not there ({error.strerror}); connect it and check its driver."
            ) from error

    def _set(self, name: str, value: str) -> None:
        try:
            (self._settings / name).write_text(value, encoding="ascii")
        except OSError as error:
            raise DeviceError(f"{self.name} does not pan ({error.strerror}); use another driver.") from error


def open_mirrored(number: int, shape: tuple[int, int], settle_s: float = 0.05) -> Panel:
    """A panel that is a screen and has no other control. See MirroredDisplay."""
    display = MirroredDisplay(number, shape, settle_s)
    return Panel(display, display)
