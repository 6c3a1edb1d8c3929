"""TI's phase light modulator on the DLPC900 controller (USB HID 0451:C900, DLPU018).

Frames can be uploaded (pattern on the fly), which takes about a minute for a whole hologram because USB HID
carries 64 KB/s: it is for calibration and tests. At video rate frames travel over the display link, as bits
that `video_pattern` draws. The commands (`dlpc900_commands`) are the same.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.panel.dlpc900_commands import (
    EVERY_COLOUR,
    IMAGE_BEGIN,
    IMAGE_DATA,
    LONGEST_DATA,
    PATTERN,
    SHORTEST_US,
    START,
    STOP,
    Dlpc900Control,
    PatternLine,
)
from firmware_iface.panel.fields import Field, FieldPanel
from firmware_iface.panel.mirrored_display import MirroredDisplay
from firmware_iface.panel.panel import Gray, Panel
from firmware_iface.panel.phase_light_modulator import P47, Modulator, bit_plane
from firmware_iface.panel.run_length_encoding import encode
from firmware_iface.usb_link import UsbLink

VENDOR, PRODUCT = 0x0451, 0xC900


MOST_PICTURES = 24  # one bit each of an image of 24 bits


class PatternUpload:
    """Frames as one-bit patterns over USB: up to 24 pictures in turn; a single one stays until the next."""

    most_fields, every_laser = MOST_PICTURES, EVERY_COLOUR

    def __init__(self, control: Dlpc900Control, modulator: Modulator = P47) -> None:
        self.shape = modulator.shape
        self._control, self._modulator = control, modulator
        self._sent = 0

    def send(self, gray: Gray) -> int:
        self.upload([gray])
        self._sent += 1
        return self._sent

    @property
    def field_us(self) -> int:
        """Time of one field, µs."""
        return self._control.exposure_us

    def send_fields(self, fields: Sequence[Field]) -> int:
        """A frame of fields: each is exposed as long as its light lasts, and dark for the rest of its time.

        The mirrors move within microseconds, so the light begins with the field, whatever its delay. Trigger output 2
        fires with the first field alone, for a camera.
        """
        lines = []
        for number, field in enumerate(fields):
            if field.lasers > EVERY_COLOUR:
                raise InputError(
                    f"{self._control.name} has LED enables for lasers 0 to 2; field {number} asks for others."
                )
            lit = bool(field.lasers) and field.width_us >= SHORTEST_US
            exposure_us = field.width_us if lit else SHORTEST_US
            lines.append(
                PatternLine(
                    exposure_us,
                    self.field_us - exposure_us,
                    field.lasers if lit else 0,
                    trigger=number == 0,
                )
            )
        self.upload([field.gray for field in fields], lines)
        self._sent += 1
        return self._sent

    def upload(self, pictures: list[Gray], lines: Sequence[PatternLine] | None = None) -> None:
        """Replace what is shown by 1 to 24 pictures, uint8 [H, W], in turn; in every colour unless lines are given."""
        if not 1 <= len(pictures) <= MOST_PICTURES:
            raise InputError(f"{len(pictures)} pictures do not fit one image; give 1 to 24.")
        rows, columns = self._modulator.memory_shape
        image = np.zeros((rows, columns), np.uint32)
        for position, gray in enumerate(pictures):
            image |= bit_plane(gray, self._modulator).astype(np.uint32) << position
        control = self._control
        control.command(PATTERN, bytes([STOP]))
        control.define(lines or [PatternLine(control.exposure_us)] * len(pictures))
        for index, half in enumerate(np.array_split(image, self._modulator.controllers, axis=1)):
            self._load(index, half)
        control.command(PATTERN, bytes([START]))

    def wait(self, sequence: int) -> None:
        if sequence != self._sent:
            raise DeviceError(
                f"{self._control.name} shows frame {self._sent}, not {sequence}; show it again."
            )
        if not self._control.status()["running"]:
            raise DeviceError(f"{self._control.name} does not run its patterns; show the frame again.")

    def close(self) -> None:
        """The control part releases the link that both use."""

    def _load(self, index: int, image: NDArray[np.uint32]) -> None:
        data = encode(image)
        self._control.command(IMAGE_BEGIN[index], struct.pack("<HI", 0, len(data)))
        for at in range(0, len(data), LONGEST_DATA):
            part = data[at : at + LONGEST_DATA]
            self._control.command(IMAGE_DATA[index], struct.pack("<H", len(part)) + part)


def video_pattern(gray: Gray, modulator: Modulator) -> Gray:
    """The picture on the display link that shows gray levels [H, W]: memory bits as 0 and 255, [2 H, 2 W].

    All 24 bit planes are alike, so the pattern stays for a whole frame.
    """
    return 255 * bit_plane(gray, modulator)


def open_dlpc900(
    display: int | None = None,
    *,
    modulator: Modulator = P47,
    receiver: str = "displayport",
    serial: str | None = None,
    backend: Any = None,
    exposure_us: int = 16000,
    timeout_s: float = 1.0,
    fields: int = 1,
) -> Panel:
    """Open a phase light modulator.

    Parameters
    ----------
    display : int or None
        N of /dev/fbN whose screen it is; None uploads frames over USB, slowly.
    modulator : Modulator
        P47 or P67.
    receiver : str
        Connection of that screen, "hdmi" or "displayport".
    serial : str or None
        Serial number, where several are attached.
    backend : pyusb backend or None
        None is the system's libusb.
    exposure_us : int, µs
        Exposure of a pattern, less than a frame of the display.
    timeout_s : float, s
        Longest wait for one transfer.
    fields : int
        Fields that a frame may need, for colours in turn. More than 1 gives a FieldPanel whose LED enables (laser 0 at
        red, 1 at green, 2 at blue) follow the pattern table's colours; `exposure_us` is then the time of a field.

    Returns
    -------
    Panel

    Raises
    ------
    InputError
        For a setting out of range.
    DeviceGoneError
        Where it is not attached.
    DeviceError
        Where it does not answer as it should.
    """
    if fields > 1 and display is not None:
        raise InputError(
            "colours in turn over the display link are not supported; leave display out, and fields are uploaded."
        )
    if fields > MOST_PICTURES:
        raise InputError(f"a frame of {fields} fields cannot be uploaded; ask for {MOST_PICTURES} at most.")
    link = UsbLink(
        VENDOR, PRODUCT, "the phase light modulator", serial=serial, backend=backend, timeout_s=timeout_s
    )
    if display is None:
        control = Dlpc900Control(link, exposure_us=exposure_us, colours=fields > 1)
        frames = PatternUpload(control, modulator)
        return FieldPanel(control, frames, fields) if fields > 1 else Panel(control, frames)
    screen = MirroredDisplay(display, modulator.shape, draw=partial(video_pattern, modulator=modulator))
    return Panel(Dlpc900Control(link, receiver, exposure_us), screen)
