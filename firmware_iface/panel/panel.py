"""A panel of two parts: control (identity, state) and frames, since frames often travel over another link."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError

Gray = NDArray[np.uint8]


class Control(Protocol):
    """The control part of a panel."""

    def status(self) -> dict[str, Any]:
        """What the panel reports, by name.

        Raises
        ------
        DeviceError
            Where it does not answer.
        """

    def close(self) -> None:
        """Leave the panel dark where it can be, and release it."""


class Frames(Protocol):
    """The part that brings frames to a panel."""

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), pixels."""

    def send(self, gray: Gray) -> int:
        """Send one whole frame and return its sequence number.

        Raises
        ------
        DeviceError
            Where it was not taken.
        """

    def wait(self, sequence: int) -> None:
        """Return when this frame is displayed.

        Raises
        ------
        DeviceError
            Where it was lost or does not come.
        """

    def close(self) -> None:
        """Release the link."""


class Panel:
    """A phase panel.

    Attributes
    ----------
    control : Control
    frames : Frames
    shape : (int, int)
        (H, W), pixels.
    """

    def __init__(self, control: Control, frames: Frames) -> None:
        self.control, self.frames = control, frames
        self.shape = frames.shape

    def show(self, gray: NDArray[np.generic]) -> None:
        """Show gray levels and return when they are displayed.

        Parameters
        ----------
        gray : uint8 array [H, W]

        Raises
        ------
        InputError
            For another type or size.
        DeviceError
            Where the panel does not show them.
        """
        self.frames.wait(self.frames.send(checked_gray(gray, self.shape)))

    def status(self) -> dict[str, Any]:
        """What the panel reports, by name; raises as `Control.status`."""
        return self.control.status()

    def close(self) -> None:
        """Leave the panel dark where it can be, and release it."""
        try:
            self.control.close()
        finally:
            self.frames.close()


def checked_gray(gray: NDArray[np.generic], shape: tuple[int, int]) -> Gray:
    """`gray`, if it is uint8 of this shape.

    Raises
    ------
    InputError
        Where it is not.
    """
    if not isinstance(gray, np.ndarray) or gray.dtype != np.uint8:
        found = gray.dtype if isinstance(gray, np.ndarray) else type(gray).__name__
        raise InputError(f"the pattern is {found}; give the panel uint8 gray levels.")
    if gray.shape != shape:
        raise InputError(f"the pattern is {gray.shape}; the panel takes (rows, columns) = {shape}.")
    return np.asarray(gray, np.uint8)
