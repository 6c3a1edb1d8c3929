"""The emulated laser board: its parts on the bus, three laser diodes, and the light that they emit.

DAC -> limiter of the safety controller -> laser-diode controller (50 mA/V, enabled by the gate, by a pin of the
expander and by the panel's light output) -> diode -> photodiode -> converter, whose ALERT goes back to the safety
controller. A photodiode's amplifier holds what it saw while the panel keeps its laser dark.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.i2c.ads1115 import Ads1115
from firmware_iface.virtual.i2c.bus import I2cBus
from firmware_iface.virtual.i2c.mcp4728 import Mcp4728
from firmware_iface.virtual.i2c.mcp23008 import Mcp23008
from firmware_iface.virtual.i2c.safety_controller import SafetyController
from firmware_iface.virtual.i2c.tmp117 import Tmp117

CONTROLLER_MA_PER_V = 50.0
BUILT_FOR = ((15000, 13000, 9000), (13000, 13000, 8000), (9000, 13000, 6000))
KEY_PIN, INTERLOCK_PIN, ALERT_PIN = 4, 5, 6


@dataclass
class Diode:
    """One laser and its photodiode.

    Attributes
    ----------
    name : str
    wavelength_nm : float, nm
    threshold_ma : float, mA
    slope_uw_per_ma : float, µW/mA
        Light at the exit pupil beyond the threshold.
    photodiode_v_per_uw : float, V/µW
    offset_ma : float, mA
        Added by the set-point knob of its controller; should be 0.
    efficiency : float
        A factor on the light, for ageing and faults.
    """

    name: str
    wavelength_nm: float
    threshold_ma: float
    slope_uw_per_ma: float
    photodiode_v_per_uw: float
    offset_ma: float = 0.0
    efficiency: float = 1.0

    def power_uw(self, current_ma: float) -> float:
        """Light at a current, µW."""
        return self.efficiency * self.slope_uw_per_ma * max(0.0, current_ma - self.threshold_ma)


def diodes() -> list[Diode]:
    """The three that the board is built with: 120, 100 and 15 µW at 1.5, 1.3 and 0.9 V."""
    return [
        Diode("red", 638.0, 45.0, 4.0, 1 / 120),
        Diode("green", 520.0, 40.0, 4.0, 1 / 100),
        Diode("blue", 450.0, 30.0, 1.0, 1 / 15),
    ]


class LaserBoard:
    """The board, powered on: dark.

    Parameters
    ----------
    clock : callable
        Gives the time, s.
    emission : callable
        Called with (time s, {laser: µW}) whenever the light changes.
    faults : Faults or None
        Script of the bus.
    gates : callable
        Gives the panel's light outputs that are open, bit k for laser k. Without a panel, all.

    Attributes
    ----------
    bus : I2cBus
    dac, expander, converter, thermometer, controller
        The models.
    diodes : list of Diode
    key, interlock : bool
        On, and closed.
    celsius : float, °C
        Of the lasers' heat sink.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        emission: Callable[[float, dict[str, float]], None] = lambda time_s, power_uw: None,
        faults: Faults | None = None,
        gates: Callable[[], int] = lambda: 0b111,
    ) -> None:
        self._clock, self._emission, self.gates = clock, emission, gates
        self._held_v = [0.0] * 3
        self._open = 0  # the panel's light outputs, as of the last time that everything was settled
        self.bus = I2cBus(self.settle, faults)
        self._key = self._interlock = False
        self._celsius = 25.0
        self._photodiode_broken = [False] * 3
        self.diodes = diodes()
        self._emitted = dict.fromkeys((d.name for d in self.diodes), 0.0)
        self.dac = Mcp4728(clock)
        self.expander = Mcp23008(self._pins)
        self.converter = Ads1115(clock, lambda pin: self.photodiode_v(pin) if pin < 3 else 0.0)
        self.thermometer = Tmp117(lambda: self._celsius)
        self.controller = SafetyController(clock, self, BUILT_FOR)
        self.bus.parts = {
            0x20: self.expander,
            0x36: self.controller,
            0x48: self.converter,
            0x49: self.thermometer,
            0x60: self.dac,
        }

    def power_cycle(self) -> None:
        """Off and on again: every part in its power-on state, the DAC as stored in its EEPROM."""
        with self.bus.lock:
            self._power_on()
        self.settle()

    def _power_on(self) -> None:
        for part in (self.dac, self.expander, self.converter, self.thermometer, self.controller):
            part.power_on()

    def settle(self) -> None:
        """Let every part do what is due by now, and report a change of light."""
        with self.bus.lock:
            if self.bus.faults.standing("unplug"):
                self._power_on()
            self._open = self.gates()
            self.thermometer.settle()
            self.controller.settle()
            self.converter.settle()  # after the limiter has come this far
            self.controller.settle()  # and ALERT with it
            emitted = {d.name: self.power_uw(k) for k, d in enumerate(self.diodes)}
            if emitted == self._emitted:
                return
            self._emitted = emitted
        self._emission(self._clock(), dict(emitted))

    @property
    def emitted_uw(self) -> dict[str, float]:
        """Light now, µW at the exit pupil, by laser."""
        self.settle()
        return dict(self._emitted)

    def power_uw(self, laser: int) -> float:
        """Light of one laser, 0 to 2, µW."""
        return self._driven_uw(laser) if self._open >> laser & 1 else 0.0

    def _driven_uw(self, laser: int) -> float:
        """Light that a laser makes where the panel's light output lets it, µW."""
        enabled = self.expander.registers[0] >> laser & 1 == 0 and self.expander.pins() >> laser & 1
        if not (self.controller.gate and enabled):
            return 0.0
        diode = self.diodes[laser]
        return diode.power_uw(CONTROLLER_MA_PER_V * self.controller.output_v(laser) + diode.offset_ma)

    # --- the board's surroundings

    @property
    def key(self) -> bool:
        """The key switch."""
        return self._key

    @key.setter
    def key(self, on: bool) -> None:
        self.settle()
        self._key = on
        self.settle()

    @property
    def interlock(self) -> bool:
        """Whether the interlock loop is closed."""
        return self._interlock

    @interlock.setter
    def interlock(self, closed: bool) -> None:
        self.settle()
        self._interlock = closed
        self.settle()

    @property
    def celsius(self) -> float:
        """Temperature of the lasers' heat sink."""
        return self._celsius

    @celsius.setter
    def celsius(self, value: float) -> None:
        self.settle()
        self._celsius = value
        self.settle()

    def break_photodiode(self, laser: int, broken: bool = True) -> None:
        """Cut (or repair) a photodiode's wire: without it the voltage is 0."""
        self.settle()
        self._photodiode_broken[laser] = broken
        self.settle()

    # --- levels at the pins of the safety controller and the expander

    def requested_v(self, laser: int) -> float:
        """Voltage from the DAC, V."""
        return self.dac.volts(laser)

    def photodiode_v(self, laser: int) -> float:
        """Voltage from a photodiode, V."""
        if self._photodiode_broken[laser]:
            return 0.0
        driven_uw = self._driven_uw(laser)
        if driven_uw == 0 or self._open >> laser & 1:
            self._held_v[laser] = driven_uw * self.diodes[laser].photodiode_v_per_uw
        return self._held_v[laser]

    def hot(self) -> bool:
        """The thermometer's ALERT."""
        return self.thermometer.alert

    def over_power(self) -> bool:
        """The converter's ALERT."""
        return self.converter.alert

    def _pins(self) -> int:
        return (
            self._key << KEY_PIN | self._interlock << INTERLOCK_PIN | (not self.converter.alert) << ALERT_PIN
        )
