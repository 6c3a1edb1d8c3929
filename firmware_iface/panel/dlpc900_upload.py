"""Frames of a DLPC900 that are uploaded over USB (pattern on the fly), for calibration and tests.

A whole hologram takes about a minute, because USB HID carries 64 KB/s.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.panel.dlpc900_commands import (
    EVERY_COLOUR,
    IMAGE_BEGIN,
    IMAGE_DATA,
    LONGEST_DATA,
    Dlpc900Control,
    PatternLine,
    lines_of,
)
from firmware_iface.panel.fields import Field
from firmware_iface.panel.panel import Gray
from firmware_iface.panel.phase_light_modulator import P47, Modulator, bit_plane
from firmware_iface.panel.run_length_encoding import encode

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
        """A frame of fields, each lit as `lines_of` says."""
        self.upload([field.gray for field in fields], lines_of(fields, self.field_us, self._control.name))
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
        control.stop()
        control.define(lines or [PatternLine(control.exposure_us)] * len(pictures))
        for index, half in enumerate(np.array_split(image, self._modulator.controllers, axis=1)):
            self._load(index, half)
        control.start()

    def wait(self, sequence: int) -> None:
        if sequence != self._sent:
            raise DeviceError(
                f"{self._control.name} shows frame {self._sent}, not {sequence}; show it again."
            )
        self._control.check_running()

    def close(self) -> None:
        """The control part releases the link that both use."""

    def _load(self, index: int, image: NDArray[np.uint32]) -> None:
        data = encode(image)
        self._control.command(IMAGE_BEGIN[index], struct.pack("<HI", 0, len(data)))
        for at in range(0, len(data), LONGEST_DATA):
            part = data[at : at + LONGEST_DATA]
            self._control.command(IMAGE_DATA[index], struct.pack("<H", len(part)) + part)
