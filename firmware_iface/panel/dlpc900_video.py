"""Frames of a DLPC900 that come over the display link, at the display's rate (video-pattern mode).

A frame of the display carries a picture of up to eight fields: field k is bit k of each colour's byte, alike in red,
green and blue, so that it does not matter which of these the controller reads first. The link has to carry 8 bits a
colour as they are: full range, no scaling, no dithering. The pattern table, sent over USB, says how long each field is
lit, and in which colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from firmware_iface.errors import InputError
from firmware_iface.panel.dlpc900_commands import EVERY_COLOUR, Dlpc900Control, PatternLine, lines_of
from firmware_iface.panel.fields import Field
from firmware_iface.panel.mirrored_display import MirroredDisplay
from firmware_iface.panel.panel import Gray
from firmware_iface.panel.phase_light_modulator import Modulator, bit_plane, bit_planes

MOST_FIELDS = 8  # bits of a colour
# Of a frame: what the sequence ends before the display's next one begins, for which it waits.
SPARE = 0.05
# The table can only be replaced while nothing is shown, so light that differs by less than this share stays as it is.
ALIKE = 0.05


class VideoFields:
    """Frames of fields over the display link, and over USB the table that lights them.

    The table is replaced where the light of a field changes by more than a twentieth, or begins or ends. For that the
    sequence stops, and all is dark for some ten milliseconds. The controller shows what the display sends, a frame of
    the display after the other, so what is lit just after that may be the frame before, in its own colours.

    Parameters
    ----------
    control : Dlpc900Control
        Which shows frames of the display link.
    display : MirroredDisplay
        Whose screen it is; it takes pictures of memory bits.
    modulator : Modulator
    """

    most_fields, every_laser = MOST_FIELDS, EVERY_COLOUR

    def __init__(self, control: Dlpc900Control, display: MirroredDisplay, modulator: Modulator) -> None:
        self.shape = modulator.shape
        self._control, self._display, self._modulator = control, display, modulator

    @property
    def field_us(self) -> int:
        """Time of one field, µs; all fields of a frame last as long as a frame of the display."""
        return self._control.exposure_us

    def send(self, gray: Gray) -> int:
        """One pattern in all colours for the whole frame; its 24 bits are alike, so the link may change their range."""
        return self._show([PatternLine(self.field_us)], 255 * bit_plane(gray, self._modulator))

    def send_fields(self, fields: Sequence[Field]) -> int:
        """A frame of fields, each lit as `lines_of` says; the table is sent only where it has to change."""
        lines = lines_of(fields, self.field_us, self._control.name)
        dark_us = lines[-1].dark_us - round(SPARE * len(lines) * self.field_us)
        if dark_us < 0:
            raise InputError(
                f"the light of field {len(lines) - 1} lasts nearly until the display's next frame, which may come "
                f"earlier; leave {SPARE:.0%} of a frame dark."
            )
        lines[-1] = replace(lines[-1], dark_us=dark_us)
        return self._show(lines, bit_planes([field.gray for field in fields], self._modulator))

    def wait(self, sequence: int) -> None:
        self._display.wait(sequence)
        self._control.check_running()

    def close(self) -> None:
        """Leave the screen dark; the control part releases its own link."""
        self._display.close()

    def _show(self, lines: Sequence[PatternLine], picture: Gray) -> int:
        """Send a picture, and its table where the light differs."""
        if _alike(lines, self._control.lines):
            return self._display.send(picture)
        self._control.stop()
        self._control.define(lines)
        sequence = self._display.send(picture)
        self._control.start()
        return sequence


def _alike(lines: Sequence[PatternLine], there: Sequence[PatternLine]) -> bool:
    """Whether a table lights its fields as another one does, but for `ALIKE` of the time of their light."""
    return len(lines) == len(there) and all(
        a.colours == b.colours and abs(a.exposure_us - b.exposure_us) <= ALIKE * a.exposure_us
        for a, b in zip(lines, there, strict=True)
    )
