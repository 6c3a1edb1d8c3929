"""Whether a photodiode sees the light that its laser's codes should make; the board's converter reads one at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

from firmware_iface.lasers.ads1115 import Ads1115
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.mcp4728 import VOLTS_PER_CODE
from firmware_iface.lasers.recent_codes import RecentCodes

SETTLED_S = 0.005  # after a change of the light or of the photodiode, as after a step of a ramp
TOLERANCE, FLOOR_V = 0.2, 0.02  # of the photodiode's voltage


class PhotodiodeWatch:
    """The codes that the lasers were given, and the photodiode that is compared with them.

    Parameters
    ----------
    converter : Ads1115
        Converts the selected photodiode.
    lasers : sequence of LaserChannel
        In the order of the DAC's outputs and of the converter's inputs.
    clock : callable
        Gives the time, s.
    held_s : float
        As `RecentCodes` takes it.
    """

    def __init__(
        self,
        converter: Ads1115,
        lasers: Sequence[LaserChannel],
        clock: Callable[[], float],
        held_s: float,
    ) -> None:
        self._converter, self._lasers, self._clock = converter, lasers, clock
        self._codes = RecentCodes(len(lasers), held_s)
        self._selected, self._selected_at, self._changed_at = 0, -math.inf, -math.inf

    def code(self, laser: int) -> int:
        """The code of a laser, from 0."""
        return self._codes.now[laser]

    def expect(self, laser: int, code: int) -> None:
        """A laser is given a new code; `changed` says when it has it."""
        self._codes.put(laser, code, self._clock())

    def expect_darkness(self) -> None:
        """Every laser is switched off."""
        for laser in range(len(self._lasers)):
            self.expect(laser, 0)
        self.changed()

    def changed(self) -> None:
        """The light changes now, and has settled a little later."""
        self._changed_at = self._clock()

    def select(self, laser: int) -> None:
        """Let the converter read a laser's photodiode from now on.

        Raises
        ------
        OSError
            Where the converter does not answer.
        """
        self._converter.select(laser)
        self._selected, self._selected_at = laser, self._clock()

    def select_next(self) -> None:
        """`select` the next laser's, after the last one the first one's."""
        self.select((self._selected + 1) % len(self._lasers))

    def deviation(self, unlit: Collection[str]) -> str:
        """What the selected photodiode shows that it should not, as a sentence; "" where all is well or unsettled.

        Parameters
        ----------
        unlit : collection of str
            Channels that are not compared.

        Raises
        ------
        OSError
            Where the converter does not answer.
        """
        if self._clock() - max(self._changed_at, self._selected_at) < SETTLED_S - 1e-6:
            return ""
        laser = self._lasers[self._selected]
        if laser.name in unlit:
            return ""
        measured_v = self._converter.volts()
        codes = self._codes.bounds(self._selected, self._clock())
        lowest_v, highest_v = (laser.photodiode_v(code * VOLTS_PER_CODE) for code in codes)
        lowest_allowed_v = (1 - TOLERANCE) * lowest_v - FLOOR_V
        if lowest_allowed_v <= measured_v <= (1 + TOLERANCE) * highest_v + FLOOR_V:
            return ""
        return (
            f"laser '{laser.name}' should make {highest_v:.3f} V at its photodiode and makes "
            f"{measured_v:.3f} V, so the lasers were switched off; check the photodiode, "
            "the calibration, and that the set point of the laser's controller is 0."
        )
