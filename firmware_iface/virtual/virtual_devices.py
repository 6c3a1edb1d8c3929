"""Panel, lasers and camera of a virtual headset: what a program calls, without the light between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError
from firmware_iface.panel.fields import Field, checked_fields
from firmware_iface.panel.panel import Gray, checked_gray

EVERY_LASER = -1
MOST_FIELDS = 24


@dataclass(frozen=True)
class LitField:
    """A pattern on the panel, and its share in a picture.

    Attributes
    ----------
    gray : uint8 array [H, W]
    lasers : int
        Which lasers shine on it, bit k for channel k; EVERY_LASER: all.
    share : float
        For how much of the time.
    """

    gray: Gray
    lasers: int = EVERY_LASER
    share: float = 1.0


class VirtualPanel:
    """The phase panel. It shows gray 0 at first.

    Parameters
    ----------
    shape : (int, int)
        (H, W), pixels.

    Attributes
    ----------
    fields : tuple of LitField
        What it shows, in turn and again.
    """

    most_fields = MOST_FIELDS
    field_us = 5556  # three in a sixtieth of a second

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self.fields: tuple[LitField, ...] = (LitField(np.zeros(shape, np.uint8)),)

    @property
    def gray(self) -> Gray:
        """The gray levels shown, uint8 [H, W]; a copy. Where several fields are shown, those of the last."""
        return self.fields[-1].gray.copy()

    def show(self, gray: NDArray[np.generic]) -> None:
        """Show gray levels, uint8 [H, W].

        Raises
        ------
        InputError
            For another type or size.
        """
        self.fields = (LitField(checked_gray(gray, self.shape).copy()),)

    def show_fields(self, fields: Sequence[Field]) -> None:
        """Show fields in turn, each lit by its own lasers, as `FieldPanel.show_fields`.

        Raises
        ------
        InputError
            As there.
        """
        checked = checked_fields(fields, self.shape, self.field_us, self.most_fields)
        frame_us = len(checked) * self.field_us
        self.fields = tuple(LitField(f.gray.copy(), f.lasers, f.width_us / frame_us) for f in checked)


class VirtualLasers:
    """The lasers, all off at first.

    Parameters
    ----------
    channels : tuple of str
        Names.
    """

    def __init__(self, channels: tuple[str, ...]) -> None:
        self.channels = channels
        self._power = dict.fromkeys(channels, 0.0)

    def set_power(self, channel: str, fraction: float) -> None:
        """Set a laser to a fraction of full power, 0 to 1.

        Raises
        ------
        InputError
            Where either is unknown.
        """
        if channel not in self._power:
            raise InputError(f"there is no laser '{channel}'; use one of {', '.join(self.channels)}.")
        if not (isinstance(fraction, int | float | np.floating) and 0 <= fraction <= 1):
            raise InputError(f"power {fraction!r} of laser '{channel}' is not a fraction; give 0 to 1.")
        self._power[channel] = float(fraction)

    def power(self, channel: str) -> float:
        """A laser's power, fraction of full."""
        if channel not in self._power:
            raise InputError(f"there is no laser '{channel}'; use one of {', '.join(self.channels)}.")
        return self._power[channel]

    def off(self) -> None:
        """Switch every laser off."""
        self._power = dict.fromkeys(self._power, 0.0)


class VirtualCamera:
    """The camera; 10 ms at first.

    Parameters
    ----------
    shape : (int, int)
        (h, w), pixels.
    bit_depth : int
        Bits of a count.
    take : callable
        Gives one picture.
    """

    def __init__(
        self, shape: tuple[int, int], bit_depth: int, take: Callable[[], NDArray[np.uint16]]
    ) -> None:
        self.shape, self.bit_depth = shape, bit_depth
        self._take = take
        self._exposure_ms = 10.0

    longest_exposure_ms = 10000.0

    @property
    def exposure_ms(self) -> float:
        """Exposure time, ms.

        Raises
        ------
        InputError
            On setting, unless above 0 and at most 10 s.
        """
        return self._exposure_ms

    @exposure_ms.setter
    def exposure_ms(self, value: float) -> None:
        if not (isinstance(value, int | float | np.floating) and 0 < value <= self.longest_exposure_ms):
            raise InputError(f"exposure {value!r} ms is out of range; give more than 0 and at most 10000.")
        self._exposure_ms = float(value)

    def capture(self) -> NDArray[np.uint16]:
        """One picture, uint16 counts [h, w], black level included."""
        return self._take()
