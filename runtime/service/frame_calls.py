"""The order of a program's frame calls, as in OpenXR's xrWaitFrame, xrBeginFrame and xrEndFrame."""

from __future__ import annotations


class OrderError(ValueError):
    """A frame call at a time when it has no meaning."""


class FrameCalls:
    """The frame that was waited for, the frame that is being drawn, and the slots that the service has.

    Attributes
    ----------
    latest : int
        Number of the latest frame; frames count from 1.
    slots : dict of int to int
        Slot of each accepted frame, by frame.
    """

    def __init__(self) -> None:
        self.latest = 0
        self._waited: int | None = None
        self._begun: int | None = None
        self.slots: dict[int, int] = {}

    def check_wait(self) -> None:
        """Check that a Wait is allowed now.

        Raises
        ------
        OrderError
            While an earlier frame waits for its Begin.
        """
        if self._waited is not None:
            raise OrderError(f"frame {self._waited} was given and not begun: send Begin before the next Wait")

    def wait(self) -> int:
        """The number of the next frame."""
        self.check_wait()
        self.latest += 1
        self._waited = self.latest
        return self.latest

    def begin(self, frame: int) -> None:
        """Drawing begins; a frame that was begun and not ended is discarded."""
        if self._waited is None or frame != self._waited:
            raise OrderError(
                f"frame {frame} was not given: send Wait, then Begin with the frame of its Timing"
            )
        self._begun, self._waited = frame, None

    def end(self, frame: int, slot: int) -> None:
        """The frame is accepted with its slot."""
        if self._begun is None or frame != self._begun:
            raise OrderError(f"frame {frame} was not begun: send Begin before End")
        if slot in self.slots.values():
            raise OrderError(f"slot {slot} still belongs to the service: use one whose frame was answered")
        self._begun = None
        self.slots[frame] = slot

    def settle(self, frame: int) -> int:
        """A frame was shown or failed; returns its slot, which is free from now on."""
        return self.slots.pop(frame)
