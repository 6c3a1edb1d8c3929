"""A panel of two parts: control (identity, state) and frames, since frames often travel over another link."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError

Gray = NDArray[np.uint8]


class Control(Protocol):
    """What every panel's control part offers."""

    def status(self) -> dict[str, Any]:
        """What the panel says of itself, by name.

        Raises
        ------
        DeviceError
        """

    def close(self) -> None:
        """Leave the panel dark where it can be, and let go of it."""


class Frames(Protocol):
    """What every way of bringing frames to a panel offers."""

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), pixels."""

    def send(self, gray: Gray) -> int:
        """Hand one whole frame over and return its sequence number.

        Raises
        ------
        DeviceError
        """

    def wait(self, sequence: int) -> None:
        """Return when this frame is what is displayed.

        Raises
        ------
        DeviceError
            Where it was lost or does not come.
        """

    def close(self) -> None:
        """Let go of the link."""


class Panel:
    """A phase panel.

    Attributes
    ----------
    control : Control
    frames : Frames
    shape
        (H, W), pixels.
    """

    def __init__(self, control: Control, frames: Frames) -> None:
        self.control, self.frames = control, frames
        self.shape = frames.shape

    def show(self, gray: NDArray[np.generic]) -> None:
        """Show gray levels, uint8 [H, W], and return when they are displayed.

        Raises
        ------
        InputError
            For another type or size.
        DeviceError
            Where the panel does not show them.
        """
        self.frames.wait(self.frames.send(checked_gray(gray, self.shape)))

    def status(self) -> dict[str, Any]:
        """What the panel says of itself.

        Raises
        ------
        DeviceError
        """
        return self.control.status()

    def close(self) -> None:
        """Leave the panel dark where it can be, and let go of it."""
        try:
            self.control.close()
        finally:
            self.frames.close()


def checked_gray(gray: NDArray[np.generic], shape: tuple[int, int]) -> Gray:
    """`gray` if it is uint8 of this shape.

    Raises
    ------
    InputError
    """
    if not isinstance(gray, np.ndarray) or gray.dtype != np.uint8:
        found = gray.dtype if isinstance(gray, np.ndarray) else type(gray).__name__
        raise InputError(f"the pattern is {found}; give the panel uint8 gray levels.")
    if gray.shape != shape:
        raise InputError(f"the pattern is {gray.shape}; the panel takes (rows, columns) = {shape}.")
    return np.asarray(gray, np.uint8)
