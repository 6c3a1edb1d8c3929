"""The order of a program's frame calls, as in OpenXR's xrWaitFrame, xrBeginFrame and xrEndFrame."""

from __future__ import annotations


class OrderError(ValueError):
    """A frame call at a time when it has no meaning."""


class FrameCalls:
    """Which frame was waited for, which is being drawn, and which slots the service has.

    Frames count from 1.
    """

    def __init__(self) -> None:
        self.latest = 0
        self._waited: int | None = None
        self._begun: int | None = None
        self.slots: dict[int, int] = {}  # of accepted frames, by frame

    def check_wait(self) -> None:
        """Raises OrderError while an earlier frame waits for its Begin."""
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
        """A frame has come to its end; returns its slot, which is free."""
        return self.slots.pop(frame)
