"""Panel, lasers and camera of a virtual headset: what a program calls, without the light between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError
from firmware_iface.panel.panel import Gray, checked_gray


class VirtualPanel:
    """The phase panel. It shows gray 0 at first.

    Parameters
    ----------
    shape : (int, int)
        (H, W), pixels.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self._gray: Gray = np.zeros(shape, np.uint8)

    @property
    def gray(self) -> Gray:
        """The gray levels shown, uint8 [H, W]; a copy."""
        return self._gray.copy()

    def show(self, gray: NDArray[np.generic]) -> None:
        """Show gray levels, uint8 [H, W].

        Raises
        ------
        InputError
            For another type or size.
        """
        self._gray = checked_gray(gray, self.shape).copy()


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
