"""The host's heartbeat: tokens that show the safety controller that the caller is alive."""

from __future__ import annotations

import math
from collections.abc import Callable

from firmware_iface.lasers.safety_controller import SafetyController

PERIOD_S = 0.025  # half of the longest that hosts may take
SOONEST_S = 0.006  # the controller takes no token within 5 ms of the last


class Heartbeat:
    """Tokens, each one more than the last, of one safety controller.

    Parameters
    ----------
    controller : SafetyController
        Its present token is the one to go on from.
    clock : callable
        Gives the time, s.

    Attributes
    ----------
    token : int
        The last one that was written, 0 to 255.
    at : float
        When it was written, by `clock`, s; long ago, where none was.
    """

    def __init__(self, controller: SafetyController, clock: Callable[[], float]) -> None:
        self._controller, self._clock = controller, clock
        self.token, self.at = controller.token(), -math.inf

    @property
    def is_due(self) -> bool:
        """Whether the last token is a period old."""
        return self._clock() - self.at >= PERIOD_S

    def beat(self) -> None:
        """Write the next token, unless that is too soon for the controller to take it.

        Raises
        ------
        OSError
            Where the controller does not answer.
        """
        if self._clock() - self.at < SOONEST_S:
            return
        self.token = (self.token + 1) % 256
        self._controller.beat(self.token)
        self.at = self._clock()
