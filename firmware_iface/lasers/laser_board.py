"""The laser board: its five parts set up together and switched off together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers.ads1115 import Ads1115
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.mcp4728 import Mcp4728
from firmware_iface.lasers.mcp23008 import Mcp23008
from firmware_iface.lasers.safety_controller import VOLTS_PER_STEP, Command, Input, SafetyController
from firmware_iface.lasers.tmp117 import Tmp117

if TYPE_CHECKING:
    from smbus2 import SMBus

TRIP_V = 1.2  # of every photodiode, whose amplifier gives 1 V at full power
HOT_CELSIUS, COOL_CELSIUS = 45.0, 40.0


class LaserBoard:
    """DAC, expander, converter, thermometer and safety controller on one bus.

    Parameters
    ----------
    bus : smbus2.SMBus
        Open.

    Attributes
    ----------
    dac : Mcp4728
    expander : Mcp23008
    converter : Ads1115
    thermometer : Tmp117
    controller : SafetyController
    """

    def __init__(self, bus: SMBus) -> None:
        self.dac, self.expander = Mcp4728(bus), Mcp23008(bus)
        self.converter, self.thermometer = Ads1115(bus), Tmp117(bus)
        self.controller = SafetyController(bus)

    def set_up(self, lasers: Sequence[LaserChannel]) -> None:
        """Make everything dark, verify that it is and would be at power-on, and set every limit.

        Parameters
        ----------
        lasers : sequence of LaserChannel
            One to three, in the order of the DAC's outputs.

        Raises
        ------
        InputError
            Where the board was not built for these lasers.
        DeviceError
            Where a part is not what it should be.
        OSError
            Where one does not answer.
        """
        self.controller.check_identity()
        self.controller.command(Command.OFF)
        self.expander.enable(0)
        self.dac.dark()
        now, at_power_on = self.dac.read()
        if not all(output.dark for output in now):
            raise DeviceError("the DAC does not go dark on command; have the laser board repaired.")
        if not all(output.dark for output in at_power_on):
            raise DeviceError(
                "the DAC's EEPROM would light lasers at power-on; with the key off, write it dark once: "
                "python -m firmware_iface.lasers.store_dark BUS"
            )
        if self.thermometer.identity() != 0x0117:
            raise DeviceError("there is no TMP117 at its address; check the laser board's wiring.")
        self.thermometer.limit(HOT_CELSIUS, COOL_CELSIUS)
        self.converter.trip_above(TRIP_V)
        held = self.thermometer.limit_celsius(), self.converter.threshold_v()
        if abs(held[0] - HOT_CELSIUS) > 0.01 or abs(held[1] - TRIP_V) > 0.001:
            raise DeviceError(
                f"the laser board holds limits of {held[0]:.1f} degrees and {held[1]:.3f} V, not {HOT_CELSIUS} and "
                f"{TRIP_V}; check its bus."
            )
        self._set_ceilings(lasers)

    def _set_ceilings(self, lasers: Sequence[LaserChannel]) -> None:
        """Write the ceilings, or check them where they are written already; lasers that are missing get 0."""
        full = [math.ceil(laser.drive_v(1.0) / VOLTS_PER_STEP - 1e-6) for laser in lasers]
        required = [(steps * VOLTS_PER_STEP, TRIP_V) for steps in full] + [(0.0, 0.0)] * (3 - len(lasers))
        for k, laser in enumerate(lasers):
            most = self.controller.maxima_v(k)
            if not (_at_most(required[k][0], most[0]) and _at_most(required[k][1], most[1])):
                raise InputError(
                    f"laser '{laser.name}' needs {required[k][0]:.4f} V for full power and the board was built for "
                    f"{most[0]:.4f} V; lower its full_power_uw."
                )
        if not self.controller.inputs() & Input.CEILINGS:
            for k, pair in enumerate(required):
                self.controller.set_ceilings(k, *pair)
        for k, pair in enumerate(required):
            found = self.controller.ceilings_v(k)
            if any(abs(f - w) > VOLTS_PER_STEP / 2 for f, w in zip(found, pair, strict=True)):
                raise DeviceError(
                    f"the safety controller holds ceilings of {found[0]:.4f} and {found[1]:.4f} V for laser {k}, not "
                    f"{pair[0]:.4f} and {pair[1]:.4f} V, and takes them once; switch the board off and on."
                )

    def go_dark(self, command: Command) -> None:
        """Switch off every part, each by itself, also where another one fails. Raises nothing.

        Parameters
        ----------
        command : Command
            For the safety controller, OFF or FAULT.
        """
        acts: tuple[Callable[[], None], ...] = (
            lambda: self.controller.command(command),
            self.dac.dark,
            lambda: self.expander.enable(0),
        )
        for act in acts:
            with suppress(Exception):  # of any kind: the next part is switched off all the same
                act()


def _at_most(value: float, most: float) -> bool:
    return value <= most + VOLTS_PER_STEP / 2
