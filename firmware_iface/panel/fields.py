"""Frames of several fields in turn: a pattern each, and which lasers may shine on it, when and for how long.

A picture in C colours with N patterns for each has C N fields: all colours in turn, N times, so that colours break up
least when the eye moves. Arrays of patterns [C N, H, W] are in this order everywhere, so field k is of colour k mod C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.panel.panel import Control, Frames, Gray, Panel, checked_gray

SETTLE_SHARE, LIGHT_SHARE = 0.25, 0.5  # of a field's time: until the panel has settled, and of light at most
SHORTEST_LIGHT_US = 20  # that a photodiode can hold; less is dark


@dataclass(frozen=True)
class Field:
    """One field of a frame.

    Attributes
    ----------
    gray : uint8 array [H, W]
    lasers : int
        Which lasers may shine, bit k for laser k in the order of the laser board's outputs; 0: a dark field.
    delay_us, width_us : int, µs
        From the start of the field to the light, and for how long.
    """

    gray: Gray
    lasers: int
    delay_us: int
    width_us: int


class FieldFrames(Frames, Protocol):
    """The part that brings frames of several fields to a panel."""

    most_fields: int

    @property
    def every_laser(self) -> int:
        """Mask of the lasers that it gates."""

    @property
    def field_us(self) -> int:
        """Time of one field, µs."""

    def send_fields(self, fields: Sequence[Field]) -> int:
        """Send one whole frame and return its sequence number; raises as `send`."""


class FieldPanel(Panel):
    """A phase panel that shows frames of several fields and gates the lasers to them.

    Parameters
    ----------
    control : Control
    frames : FieldFrames
    fields : int
        Fields of a usual frame.

    Attributes
    ----------
    fields : int
    gated : GatedLight or None
        Light that the lasers' power is budgeted for: a frame with more is refused. None: whoever shows frames and
        powers the lasers sees to it.
    """

    def __init__(self, control: Control, frames: FieldFrames, fields: int) -> None:
        super().__init__(control, frames)
        self._fields = frames
        self.fields = fields
        self.gated: GatedLight | None = None

    @property
    def field_us(self) -> int:
        """Time of one field, µs."""
        return self._fields.field_us

    def show(self, gray: NDArray[np.generic]) -> None:
        """Show one pattern in all fields of a usual frame; every laser may shine on the first.

        So no laser shines for more of the time than in a picture of all colours. Raises as `show_fields`.
        """
        delay_us, width_us = light_times_us(self.field_us)
        every = self._fields.every_laser
        one = checked_gray(gray, self.shape)
        self.show_fields([Field(one, 0 if k else every, delay_us, width_us) for k in range(self.fields)])

    def show_fields(self, fields: Sequence[Field]) -> None:
        """Show a frame of fields, in turn and again, and return when it is displayed.

        The frame is swapped in as a whole; until then the frame before is displayed with all of its fields.

        Parameters
        ----------
        fields : sequence of Field

        Raises
        ------
        InputError
            For another number, type or size, light that does not fit a field's time, or more than is budgeted.
        DeviceError
            Where the panel does not show them.
        """
        checked = checked_fields(fields, self.shape, self.field_us, self._fields.most_fields)
        if self.gated is not None:
            check_light(checked, self.field_us, self.gated)
        self.frames.wait(self._fields.send_fields(checked))


def checked_fields(
    fields: Sequence[Field], shape: tuple[int, int], field_us: int, most_fields: int
) -> list[Field]:
    """`fields`, if a panel can show them.

    Raises
    ------
    InputError
        Where it cannot.
    """
    if not 1 <= len(fields) <= most_fields:
        raise InputError(f"a frame of {len(fields)} fields cannot be shown; give 1 to {most_fields}.")
    for number, field in enumerate(fields):
        checked_gray(field.gray, shape)
        if not 0 <= field.lasers < 256:
            raise InputError(f"the lasers of field {number} are {field.lasers}; give a mask of 0 to 255.")
        if min(field.delay_us, field.width_us) < 0 or field.delay_us + field.width_us > field_us:
            raise InputError(
                f"the light of field {number} does not fit its {field_us} µs; lower its delay or its width."
            )
    return list(fields)


def check_light(fields: Sequence[Field], field_us: int, gated: GatedLight) -> None:
    """Check that a frame, shown again and again, gives no laser more light than is budgeted.

    Raises
    ------
    InputError
        Where a laser shines in more fields or for longer, or the frame is shorter.
    """
    if len(fields) * field_us < round(1e6 * gated.frame_s):
        raise InputError(
            f"a frame of {len(fields)} fields of {field_us} µs is shorter than the {gated.frame_s:g} s that the "
            "lasers are budgeted for; show all fields of a frame."
        )
    for laser in range(max(field.lasers for field in fields).bit_length()):
        widths = [field.width_us for field in fields if field.lasers >> laser & 1 and field.width_us]
        if len(widths) > gated.pulses or max(widths, default=0) > round(1e6 * gated.pulse_s):
            raise InputError(
                f"laser {laser} would shine in {len(widths)} fields, up to {max(widths)} µs in each, and is budgeted "
                f"for {gated.pulses} of {round(1e6 * gated.pulse_s)} µs; show fewer or shorter ones."
            )


def light_times_us(field_us: int) -> tuple[int, int]:
    """From the start of a field until the panel has settled, and the longest light after that, µs."""
    return round(SETTLE_SHARE * field_us), int(LIGHT_SHARE * field_us)


def colours_in_turn(
    grays: NDArray[np.uint8], lasers: Sequence[int], brightness: Sequence[float], field_us: int
) -> list[Field]:
    """The frame of a picture in C colours with N patterns for each: every pattern a field, lit by its own laser alone.

    The light begins when the panel has settled, and lasts in proportion to the colour's brightness, alike in all of its
    fields.

    Parameters
    ----------
    grays : uint8 array [C N, H, W]
        The patterns: of all colours in turn, N times.
    lasers : sequence of int
        The laser of each colour, counted from 0.
    brightness : sequence of float
        0 (dark) to 1 for each colour.
    field_us : int, µs
        Time of one field.

    Returns
    -------
    list of Field

    Raises
    ------
    InputError
        Where the patterns are no whole number for each colour.
    """
    if len(grays) % len(lasers):
        raise InputError(
            f"{len(grays)} patterns are no whole number for each of {len(lasers)} colours; give every colour as many."
        )
    delay_us, most_us = light_times_us(field_us)
    lights = []
    for laser, share in zip(lasers, brightness, strict=True):
        width_us = round(min(1.0, max(0.0, share)) * most_us)
        width_us = width_us if width_us >= SHORTEST_LIGHT_US else 0
        lights.append((1 << laser if width_us else 0, delay_us, width_us))
    return [Field(gray, *lights[k % len(lights)]) for k, gray in enumerate(grays)]
